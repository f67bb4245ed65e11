# SPDX-License-Identifier: Apache-2.0
"""Is the rig as it is described: swapped cameras, the vehicle's own body in view, turned mounts."""
