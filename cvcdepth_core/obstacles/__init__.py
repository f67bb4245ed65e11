# SPDX-License-Identifier: Apache-2.0
"""What a driver makes of a cloud: the ground, what stands on it, and the nearest of that all around."""
