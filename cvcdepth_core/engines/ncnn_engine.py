# SPDX-License-Identifier: Apache-2.0
"""NCNN: convolutions by Winograd's method on any CPU, 26 MB, ready at once."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cvcdepth_core.engines.ncnn_graph import INPUT, OUTPUT, ncnn_model
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks import DepthNet


class NcnnEngine:
    """The rewritten network in NCNN, on as many threads as torch has when it is built."""

    device = torch.device("cpu")

    def __init__(self, network: DepthNet) -> None:
        import ncnn

        self._ncnn = ncnn
        self.name = f"ncnn {ncnn.__version__} float32"
        self._net = ncnn.Net()
        self._net.opt.num_threads = torch.get_num_threads()
        # Where a CPU or GPU could compute in 16 bits, NCNN would.
        for option in ("fp16_packed", "fp16_storage", "fp16_arithmetic", "bf16_storage", "vulkan_compute"):
            setattr(self._net.opt, f"use_{option}", False)
        self._load(*ncnn_model(RewrittenDepthNet(network, transposed=False)))

    def disparity(self, images: Tensor) -> Tensor:
        """See `DisparityEngine`."""
        return torch.from_numpy(np.stack([self._one(image) for image in images.numpy()]))

    def _one(self, image: np.ndarray) -> np.ndarray:
        extractor = self._net.create_extractor()
        # A Mat made from an array neither owns nor keeps it; a clone has memory of its own.
        extractor.input(INPUT, self._ncnn.Mat(np.ascontiguousarray(image)).clone())
        failed, disparity = extractor.extract(OUTPUT)
        if failed:
            raise EngineError(f"{self.name}: inference failed with code {failed} on an image of {image.shape}")
        return np.array(disparity)

    def _load(self, param: str, weights: bytes) -> None:
        """NCNN reads memory only if it outlives the network, so it is given files."""
        with tempfile.TemporaryDirectory(prefix="cvcdepth_ncnn_") as folder:
            param_file, weights_file = Path(folder, "param"), Path(folder, "bin")
            param_file.write_text(param, encoding="ascii")
            weights_file.write_bytes(weights)
            failed = self._net.load_param(str(param_file)) or self._net.load_model(str(weights_file))
        if failed:
            raise EngineError(f"{self.name}: cannot load the network, code {failed}")
