# SPDX-License-Identifier: Apache-2.0
"""Depth made better by geometry, without labels and without training: motion, mounts, plane sweeps, confidence."""
