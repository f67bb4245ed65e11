# SPDX-License-Identifier: Apache-2.0
"""What `bag_replay bench` and the benchmarks measure against and with."""
