# SPDX-License-Identifier: Apache-2.0
"""Several processes that compute one training run, started by torchrun; gloo between CPUs, NCCL between GPUs.

Gradients are added up over the processes and divided by the samples of all, so it does not matter how many samples a
process had; torch's DistributedDataParallel would average over processes instead, and wait for ever where one of them
could not read its pictures. So that a step computes what one process would with all the samples, batch normalisation
takes its statistics over the samples of all processes too.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor, distributed, nn

from cvcdepth_core.errors import ConfigError

# The others wait for as long as the first process validates. A process that died is noticed by torchrun, not by this.
_PATIENCE = timedelta(hours=12)


@dataclass(frozen=True)
class Processes:
    """The processes that compute a run together; by default this single one."""

    rank: int = 0
    """This process's number; only the first, 0, writes and reports."""
    count: int = 1
    """How many there are."""

    @property
    def is_first(self) -> bool:
        """Whether this process writes and reports."""
        return self.rank == 0

    def sum_over_processes(self, values: Tensor) -> Tensor:
        """Replace `values`, of the same shape in every process, by their sum over the processes; returns them."""
        if self.count > 1:
            distributed.all_reduce(values)
        return values

    def sum_gradients_over_processes(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace the gradients by their sums over the processes, in one message."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        if self.count == 1 or not gradients:
            return
        sums = self.sum_over_processes(torch.cat([gradient.flatten() for gradient in gradients]))
        parts = torch.split_with_sizes(sums, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def broadcast_from_first(self, content: bytes) -> bytes:
        """Return the first process's `content` in every process, which waits for it."""
        contents = [content]
        if self.count > 1:
            distributed.broadcast_object_list(contents, src=0)
        return contents[0]

    @contextmanager
    def first_process_first(self) -> Iterator[None]:
        """Run the block in the first process before it begins in the others, which find what the first has written."""
        if not self.is_first:
            self.broadcast_from_first(b"")
        yield
        if self.is_first:
            self.broadcast_from_first(b"")


SINGLE_PROCESS = Processes()
"""This process, without others."""


@contextmanager
def launched_processes() -> Iterator[Processes]:
    """Join the other processes that torchrun started; without torchrun, or with one process, there is only this one."""
    count = int(os.environ["WORLD_SIZE"]) if distributed.is_torchelastic_launched() else 1
    if count == 1:
        yield SINGLE_PROCESS
        return
    distributed.init_process_group(timeout=_PATIENCE)
    yield Processes(distributed.get_rank(), count)
    distributed.destroy_process_group()  # not after an error: it could wait for processes that went on


def own_device(device: torch.device) -> torch.device:
    """Return this process's own GPU where torchrun started several and `device` is CUDA, else `device`.

    Raises ConfigError when torchrun started more processes on this machine than it has GPUs.
    """
    if device.type != "cuda" or not distributed.is_torchelastic_launched():
        return device
    number, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if number >= count:
        raise ConfigError(f"torchrun started process {number + 1} on this machine, which has {count} GPUs")
    own = torch.device("cuda", number)
    torch.cuda.set_device(own)
    return own


def share_batch_statistics(network: nn.Module, device: torch.device) -> nn.Module:
    """Let the batch normalisation of `network` see the samples of all processes; its weights keep their names."""
    if device.type == "cuda":
        return nn.SyncBatchNorm.convert_sync_batchnorm(network)  # type: ignore[no-any-return, no-untyped-call]
    for module in network.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = _SharedBatchNorm
    return network


class _SharedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation over all processes on CPUs, which torch's SyncBatchNorm does not support."""

    momentum: float
    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def forward(self, images: Tensor) -> Tensor:
        if not self.training:
            return super().forward(images)
        values = images.to(self.weight.dtype)
        count = values.new_full((1,), values.numel() / values.shape[1])
        distributed.all_reduce(count)
        mean = _sum_over_processes(values.sum((0, 2, 3))) / count
        centred = values - mean[:, None, None]
        variance = _sum_over_processes(centred.square().sum((0, 2, 3))) / count
        with torch.no_grad():
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * count / (count - 1), self.momentum)
        scale = self.weight * (variance + self.eps).rsqrt()
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(images.dtype)


def _sum_over_processes(values: Tensor) -> Tensor:
    total: Tensor = _Sum.apply(values)  # type: ignore[no-untyped-call]
    return total


class _Sum(torch.autograd.Function):
    """Sum over the processes, each of which has a part of the loss that depends on it."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        total = values.clone()
        distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        total = gradients[0].clone()
        distributed.all_reduce(total)
        return total
