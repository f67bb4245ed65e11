# SPDX-License-Identifier: Apache-2.0
"""Surround sets: matching images in time, estimating their depth, and the messages made of it."""
