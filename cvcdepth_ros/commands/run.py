# SPDX-License-Identifier: Apache-2.0
"""`run`: depth."""

import argparse

SUMMARY = """Compute"""
EXAMPLES: tuple[str, ...] = ()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""


def execute(arguments: argparse.Namespace) -> None:
    """Declare the options."""
