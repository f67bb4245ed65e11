# SPDX-License-Identifier: Apache-2.0
"""Make the file that is shipped from a run's checkpoint: half precision, with both networks and where it comes from.

python tools/release_checkpoint.py run/best.safetensors -o cvcdepth_core/models/default.safetensors
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from cvcdepth_core.networks.checkpoint import load_checkpoint, save_checkpoint


def main() -> None:
    """Read, halve, write, and print the new file's hash."""
    options = parse_options()
    trained = load_checkpoint(options.checkpoint)
    metadata = trained.metadata | {"released_from": f"sha256:{trained.sha256}"}
    save_checkpoint(options.output, trained.spec, halved(trained.depth_net), halved(trained.pose_net), metadata)
    released = load_checkpoint(options.output)
    print(f"{options.output}: {options.output.stat().st_size / 1e6:.1f} MB, sha256:{released.sha256}")


def halved(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the floating-point tensors in half precision; counters stay as they are."""
    return {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in state.items()}


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a run's checkpoint")
    parser.add_argument("-o", "--output", type=Path, required=True, help="file to write")
    return parser.parse_args()


if __name__ == "__main__":
    main()
