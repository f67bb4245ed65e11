# SPDX-License-Identifier: Apache-2.0
"""Drives a real node with a recording over DDS and keeps what it publishes."""
