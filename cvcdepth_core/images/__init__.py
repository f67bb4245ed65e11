# SPDX-License-Identifier: Apache-2.0
"""From encoded bytes to the pictures that the networks see."""
