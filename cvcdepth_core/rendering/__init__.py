# SPDX-License-Identifier: Apache-2.0
"""Projection between cameras, views rendered from other views, and how well they agree."""
