# SPDX-License-Identifier: Apache-2.0
"""Meshes, and the things of a street as meshes."""
