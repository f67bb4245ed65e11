# SPDX-License-Identifier: Apache-2.0
"""The objective and the trainer."""
