# SPDX-License-Identifier: Apache-2.0
"""A fleet's side of training: what comes before, proof on the held-out part, promotion, card and page. No ROS here."""
