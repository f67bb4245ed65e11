# SPDX-License-Identifier: Apache-2.0
"""NCNN: convolutions by Winograd's method on any CPU, 26 MB, ready at once."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cvcdepth_core.engines.engine import image_by_image
from cvcdepth_core.engines.ncnn_graph import INPUT, OUTPUT, ncnn_model
from cvcdepth_core.engines.rewriting import RewrittenDepthNet
from cvcdepth_core.engines.rewriting_conditioned import RewrittenRigConditionedNet, ToldDetails
from cvcdepth_core.errors import EngineError
from cvcdepth_core.networks import DepthNet, DepthOutputs, RigImages
from cvcdepth_core.networks.rig_conditioned import RigConditionedNet


class NcnnEngine:
    """The rewritten network in NCNN, on as many threads as torch has when it is built.

    Several images are computed side by side: NCNN's own threads wait for each other in every layer.
    """

    device = torch.device("cpu")
    chunk = None

    def __init__(self, network: DepthNet | RigConditionedNet) -> None:
        import ncnn

        self._ncnn = ncnn
        self.name = f"ncnn {ncnn.__version__} float32"
        self._threads = self._threads_per_image = torch.get_num_threads()
        self._pool = ThreadPoolExecutor(self._threads, "ncnn")
        self._model = ncnn_model(self._graph(network))
        self._net = self._load()

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`. The largest set so far decides how many threads each image has."""
        return image_by_image(lambda images: self._each({INPUT: images}), rig)

    def _graph(self, network: Any) -> nn.Module:
        return RewrittenDepthNet(network, transposed=False)

    def _each(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the output of each image and of what belongs to it."""
        images = len(inputs[INPUT])
        threads = max(1, self._threads // images)
        if threads < self._threads_per_image:
            self._threads_per_image = threads
            self._net = self._load()
        each = [{name: values[i].numpy() for name, values in inputs.items()} for i in range(images)]
        return torch.from_numpy(np.stack(list(self._pool.map(partial(self._one, self._net), each))))

    def _one(self, net: Any, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        extractor = net.create_extractor()
        for name, values in inputs.items():
            # A Mat made from an array does not keep it alive, which it has to be until the clone has memory of its own.
            contiguous = np.ascontiguousarray(values)
            extractor.input(name, self._ncnn.Mat(contiguous).clone())
        failed, disparity = extractor.extract(OUTPUT)
        if failed:
            raise EngineError(f"{self.name}: inference failed with code {failed} on an image of {inputs[INPUT].shape}")
        return np.array(disparity)

    def _load(self) -> Any:
        """Return the network for so many threads an image, which NCNN lays its weights out for.

        NCNN reads memory only if it outlives the network, so it is given files.
        """
        net = self._ncnn.Net()
        net.opt.num_threads = self._threads_per_image
        # Where a CPU or GPU could compute in 16 bits, NCNN would.
        for option in ("fp16_packed", "fp16_storage", "fp16_arithmetic", "bf16_storage", "vulkan_compute"):
            setattr(net.opt, f"use_{option}", False)
        with tempfile.TemporaryDirectory(prefix="cvcdepth_ncnn_") as folder:
            param_file, weights_file = Path(folder, "param"), Path(folder, "bin")
            param_file.write_text(self._model[0], encoding="ascii")
            weights_file.write_bytes(self._model[1])
            failed = net.load_param(str(param_file)) or net.load_model(str(weights_file))
        if failed:
            raise EngineError(f"{self.name}: cannot load the network, code {failed}")
        return net


class ConditionedNcnnEngine(NcnnEngine):
    """The network that is told its rig: NCNN is given what is made of each calibration once, beside the picture."""

    def __init__(self, network: RigConditionedNet) -> None:
        super().__init__(network)
        self._details = ToldDetails(network, self.device)

    def disparity(self, rig: RigImages) -> Tensor:
        """See `DisparityEngine`."""
        return self.details(rig).disparity

    def details(self, rig: RigImages) -> DepthOutputs:
        """See `DetailedEngine`."""
        return self._details(rig, self._each)

    def _graph(self, network: Any) -> nn.Module:
        return RewrittenRigConditionedNet(network)
