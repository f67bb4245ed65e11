# SPDX-License-Identifier: Apache-2.0
"""The baselines that `cvcdepth bench` and the benchmarks measure against."""
