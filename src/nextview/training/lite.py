"""EfficientNet-Lite0: a small recogniser whose first weights can come from ImageNet."""

from __future__ import annotations

import torch
from torch import Tensor, nn

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
FEATURES = 1280


class Depthwise(nn.Conv2d):
    """A kernel for each channel, always in float32: in bfloat16 its gradient is slow on a CPU."""

    def __init__(self, width: int, kernel: int, stride: int) -> None:
        super().__init__(width, width, kernel, stride, kernel // 2, groups=width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


class InvertedBottleneck(nn.Module):
    """Widen, filter each channel, narrow; with a shortcut where nothing changes its shape."""

    def __init__(self, inputs: int, expansion: int, width: int, kernel: int, stride: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = nn.Conv2d(inputs, wide, 1, bias=False) if expansion > 1 else nn.Identity()
        self.norm0 = _norm(wide) if expansion > 1 else nn.Identity()
        self.depthwise, self.norm1 = Depthwise(wide, kernel, stride), _norm(wide)
        self.project, self.norm2 = nn.Conv2d(wide, width, 1, bias=False), _norm(width)
        self.relu, self.expands = nn.ReLU6(inplace=True), expansion > 1
        self.has_shortcut = stride == 1 and inputs == width

    def forward(self, x: Tensor) -> Tensor:
        past = x
        if self.expands:
            x = self.relu(self.norm0(self.expand(x)))
        x = self.relu(self.norm1(self.depthwise(x)))
        x = self.norm2(self.project(x))
        return x + past if self.has_shortcut else x


class LiteNet(nn.Module):
    """EfficientNet-Lite0: EfficientNet-B0 without squeeze and excitation, with ReLU6 for swish.

    A fifth of the arithmetic of a ResNet-18 and three tenths of its parameters. ``forward`` returns what
    ``networks.ResNet`` does, with pooled features (B, 1280). For first weights see ``weights.load_imagenet``.

    Args:
        classes: outputs.
        channels: of the input image (B, channels, H, W), values in 0 .. 1.
        azimuths: sides that are told apart; 0 for none.
    """

    name, blocks = "EfficientNet-Lite0", 1

    def __init__(self, classes: int, channels: int, azimuths: int = 0) -> None:
        super().__init__()
        inputs, stages = 32, []
        self.stem, self.norm0 = nn.Conv2d(channels, inputs, 3, 2, 1, bias=False), _norm(inputs)
        for expansion, width, kernel, stride, length in STAGES:
            for index in range(length):
                stages.append(InvertedBottleneck(inputs, expansion, width, kernel, 1 if index else stride))
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
        x = self.stages(self.relu(self.norm0(self.stem(x))))
        features = self.avgpool(self.relu(self.norm1(self.head(x)))).flatten(1)
        logits = self.fc(features)
        if self.side is None:
            return logits, features
        return logits, features, self.side(features).unflatten(1, (-1, self.azimuths)).log_softmax(2)


def _norm(width: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(width, eps=1e-3)  # EfficientNet's epsilon: checkpoints count on it
