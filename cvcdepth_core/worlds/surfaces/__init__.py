# SPDX-License-Identifier: Apache-2.0
"""Colours and textures of surfaces, evaluated anywhere."""
