# SPDX-License-Identifier: Apache-2.0
"""Metrics against truth, and what can be measured without it."""
