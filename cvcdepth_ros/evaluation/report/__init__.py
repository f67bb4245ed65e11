# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one page that needs nothing beside it, with tables, diagrams and pictures of an evaluation."""
