# SPDX-License-Identifier: Apache-2.0
"""Worlds and rigs thought up from a seed."""
