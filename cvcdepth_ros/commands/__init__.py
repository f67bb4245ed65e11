# SPDX-License-Identifier: Apache-2.0
"""The commands of `cvcdepth`, one a module: options, and what is shown of the result. The work is done elsewhere.

Modules import what is heavy inside `execute`, so that `--help` and wrong use answer at once.
"""
