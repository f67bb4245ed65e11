# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning on recordings: preparation, held-out scores, verdict and promotion, model card. No ROS here."""
