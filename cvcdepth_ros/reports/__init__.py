# SPDX-License-Identifier: Apache-2.0
"""HTML pages and figures."""
