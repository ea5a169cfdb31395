"""EfficientNet-Lite0: a small recogniser whose first weights can come from ImageNet."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

STAGES = (
    (1, 16, 3, 1, 1),
    (6, 24, 3, 2, 2),
    (6, 40, 5, 2, 2),
    (6, 80, 3, 2, 3),
    (6, 112, 5, 1, 3),
    (6, 192, 5, 2, 4),
    (6, 320, 3, 1, 1),
)
"""Expansion, width, kernel, stride and blocks of the seven stages (Tan and Le, EfficientNet, ICML 2019, table 1)."""
BLOCKS = sum(length for *_, length in STAGES)
FEATURES = 1280


class Depthwise(nn.Conv2d):
    """A kernel for each channel, always in float32: in bfloat16 its gradient is slow on a CPU."""

    def __init__(self, width: int, kernel: int, stride: int) -> None:
        super().__init__(width, width, kernel, stride, kernel // 2, groups=width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


class InvertedBottleneck(nn.Module):
    """Widen, filter each channel, narrow; with a shortcut where nothing changes its shape.

    In training, a block with a shortcut is skipped for each image with chance ``skip`` (stochastic depth).
    """

    def __init__(self, inputs: int, expansion: int, width: int, kernel: int, stride: int, skip: float = 0.0) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = nn.Conv2d(inputs, wide, 1, bias=False) if expansion > 1 else nn.Identity()
        self.norm0 = _norm(wide) if expansion > 1 else nn.Identity()
        self.depthwise, self.norm1 = Depthwise(wide, kernel, stride), _norm(wide)
        self.project, self.norm2 = nn.Conv2d(wide, width, 1, bias=False), _norm(width)
        self.relu, self.expands = nn.ReLU6(inplace=True), expansion > 1
        self.has_shortcut, self.skip = stride == 1 and inputs == width, skip

    def forward(self, x: Tensor) -> Tensor:
        past = x
        if self.expands:
            x = self.relu(self.norm0(self.expand(x)))
        x = self.relu(self.norm1(self.depthwise(x)))
        x = self.norm2(self.project(x))
        if not self.has_shortcut:
            return x
        if self.training and self.skip:
            x = x * (torch.rand(len(x), 1, 1, 1, device=x.device) >= self.skip) / (1 - self.skip)
        return x + past


class LiteNet(nn.Module):
    """EfficientNet-Lite0: EfficientNet-B0 without squeeze and excitation, with ReLU6 for swish (TensorFlow, 2020).

    It has a fifth of the arithmetic of a ResNet-18 and three tenths of its parameters. ``forward`` returns what
    ``networks.ResNet`` does. For first weights see ``weights.load_checkpoint``.

    Args:
        classes: outputs.
        channels: of the input image (B, channels, H, W), values in 0 .. 1.
        azimuths: azimuth bins that are told apart; 0 for none.
        dropout: chance in training that a pooled feature is dropped; the chance that a block with a shortcut is skipped
            for an image rises from 0 at the first block towards it at the last.
    """

    name = "EfficientNet-Lite0"

    def __init__(self, classes: int, channels: int, azimuths: int = 0, dropout: float = 0.0) -> None:
        super().__init__()
        self.dropout, inputs = dropout, 32
        self.stem, self.norm0 = nn.Conv2d(channels, inputs, 3, 2, 1, bias=False), _norm(inputs)
        stages: list[nn.Module] = []
        for expansion, width, kernel, stride, length in STAGES:
            for index in range(length):
                step, skip = 1 if index else stride, dropout * len(stages) / BLOCKS
                stages.append(InvertedBottleneck(inputs, expansion, width, kernel, step, skip))
                inputs = width
        self.stages = nn.Sequential(*stages)
        self.head, self.norm1 = nn.Conv2d(inputs, FEATURES, 1, bias=False), _norm(FEATURES)
        self.relu, self.avgpool = nn.ReLU6(inplace=True), nn.AdaptiveAvgPool2d(1)
        self.fc = nn.Linear(FEATURES, classes)
        self.azimuths = azimuths
        self.side = nn.Linear(FEATURES, classes * azimuths) if azimuths else None
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        return self.answers(self.features(x))

    def features(self, x: Tensor) -> Tensor:
        """Of images, (B, F)."""
        x = self.stages(self.relu(self.norm0(self.stem(x))))
        return self.avgpool(self.relu(self.norm1(self.head(x)))).flatten(1)

    def answers(self, features: Tensor) -> tuple[Tensor, ...]:
        """What ``forward`` returns, by features."""
        features = F.dropout(features, self.dropout, self.training)
        logits = self.fc(features)
        if self.side is None:
            return (logits,)
        return logits, self.side(features).unflatten(1, (-1, self.azimuths)).log_softmax(2)


def _norm(width: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(width, eps=1e-3)  # EfficientNet's epsilon: checkpoints count on it
