# SPDX-License-Identifier: Apache-2.0
"""Kept for the commands in older notes: `cvcdepth import CHECKPOINT --half -o OUT` is what it calls.

python tools/release_checkpoint.py CHECKPOINT -o OUT
"""

import sys

from cvcdepth_ros.bag_replay import main

if __name__ == "__main__":
    sys.exit(main(["import", *sys.argv[1:], "--half", "--force"]))
