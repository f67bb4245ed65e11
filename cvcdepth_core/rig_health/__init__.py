# SPDX-License-Identifier: Apache-2.0
"""Does the rig match its description: swapped cameras, the vehicle's own body in view, turned mounts, dirty lenses."""
