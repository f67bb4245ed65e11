# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the real node and the real tool."""
