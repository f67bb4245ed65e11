# SPDX-License-Identifier: Apache-2.0
"""What `cvcdepth bench` and the benchmarks measure against and with."""
