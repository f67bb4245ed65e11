# SPDX-License-Identifier: Apache-2.0
"""Kept for the commands in older notes: `cvcdepth import CLASSIFIER --config CONFIG -o OUT` is what it calls.

python tools/imagenet_checkpoint.py CONFIG CLASSIFIER -o OUT [--initial-depth M]
"""

import sys

from cvcdepth_ros.bag_replay import main

if __name__ == "__main__":
    config, *others = sys.argv[1:]
    sys.exit(main(["import", *others, "--config", config, "--force"]))
