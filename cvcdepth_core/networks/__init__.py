# SPDX-License-Identifier: Apache-2.0
"""The depth and pose networks (method, sections 3 and 4)."""
