# SPDX-License-Identifier: Apache-2.0
"""`python -m cvcdepth_ros.demo`: a recording played to the live node over DDS, and what it publishes."""
