"""Layers of both networks: batch norm over all processes, and linear layers that read coordinates."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.nets import distributed


class BatchNorm(nn.BatchNorm1d):
    """Batch norm of rows (n, channels) with the moments over all processes (also on CPUs, unlike SyncBatchNorm)."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or distributed.num_processes() == 1:
            return super().forward(x)
        rows = x.float()
        # every process has the same number of rows
        mean, square = distributed.average(torch.stack([rows.mean(0), rows.square().mean(0)]))
        var = square - mean.square()
        count = len(x) * distributed.num_processes()
        with torch.no_grad():
            self.get_buffer("running_mean").lerp_(mean, self.momentum or 0.0)
            self.get_buffer("running_var").lerp_(var * (count / (count - 1)), self.momentum or 0.0)
        scale = self.weight * torch.rsqrt(var + self.eps)
        return (rows * scale + (self.bias - mean * scale)).to(x.dtype)


class CoordinateLinear(nn.Linear):
    """A linear layer that reads coordinates: in float32 also under autocast.

    In bfloat16 a coordinate of 50 m is rounded to 0.25 m.
    """

    def forward(self, x: Tensor) -> Tensor:
        device = x.device.type
        if not torch.is_autocast_enabled(device):
            return super().forward(x)
        with torch.autocast(device, enabled=False):
            y = F.linear(x.float(), self.weight, self.bias)
        return y.to(torch.get_autocast_dtype(device))
