# SPDX-License-Identifier: Apache-2.0
"""Training: configuration, objective, trainer, and what a run keeps in its folder."""
