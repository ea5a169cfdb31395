"""The networks: ResNet with torchvision's parameter names, PointNet with its two transforms, and a ResNet of maps."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nextview.training.inputs import CHANNELS_OF
from nextview.training.lite import LiteNet
from nextview.training.recipes import MapRecipe, RecogniserRecipe
from nextview.viewsphere import ViewSphere

RESNETS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3), 152: (3, 8, 36, 3)}
"""Blocks in the four stages of each ResNet (He et al., CVPR 2016, table 1)."""


def shortcut(inputs: int, outputs: int, stride: int) -> nn.Module | None:
    """What brings a block's input to the shape of its output; None where they are alike."""
    if stride == 1 and inputs == outputs:
        return None
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut."""

    expansion = 1

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = shortcut(inputs, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        past = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(x)) + past)


class Bottleneck(nn.Module):
    """Three convolutions, the 3x3 one narrow and with the stride, as in torchvision, and a shortcut."""

    expansion = 4

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * self.expansion
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = shortcut(inputs, outputs, stride)

    def forward(self, x: Tensor) -> Tensor:
        past = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)))
        return self.relu(self.bn3(self.conv3(x)) + past)


class ResNet(nn.Module):
    """A ResNet; ``forward`` returns the logits (B, classes), in a tuple.

    With ``azimuths``, it returns also the logarithms of how likely each of so many azimuth bins of the object is the
    one that is seen, if it is of each class, (B, classes, azimuths). Parameters carry torchvision's names, so that its
    checkpoints fit; see ``weights.load_checkpoint``.

    Args:
        depth: 18, 34, 50, 101 or 152.
        classes: outputs.
        channels: of the input image (B, channels, H, W), values in 0 .. 1.
        azimuths: azimuth bins that are told apart; 0 for none.
    """

    def __init__(self, depth: int, classes: int, channels: int, azimuths: int = 0) -> None:
        super().__init__()
        block = BasicBlock if depth < 50 else Bottleneck
        self.conv1 = nn.Conv2d(channels, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        inputs = 64
        for stage, length in enumerate(RESNETS[depth]):
            layer = []
            for index in range(length):
                layer.append(block(inputs, 64 << stage, 2 if stage and not index else 1))
                inputs = (64 << stage) * block.expansion
            setattr(self, f"layer{stage + 1}", nn.Sequential(*layer))
        self.avgpool = nn.AdaptiveAvgPool2d(1)
        self.fc = nn.Linear(inputs, classes)
        self.name, self.azimuths = f"ResNet-{depth}", azimuths
        self.side = nn.Linear(inputs, classes * azimuths) if azimuths else None
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        for module in self.modules():  # each block begins as the identity, which steadies large rates
            if isinstance(module, BasicBlock):
                nn.init.zeros_(module.bn2.weight)
            elif isinstance(module, Bottleneck):
                nn.init.zeros_(module.bn3.weight)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        return self.answers(self.features(x))

    def features(self, x: Tensor) -> Tensor:
        """Of images, (B, F)."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
        return self.avgpool(x).flatten(1)

    def answers(self, features: Tensor) -> tuple[Tensor, ...]:
        """What ``forward`` returns, by features."""
        logits = self.fc(features)
        if self.side is None:
            return (logits,)
        return logits, self.side(features).unflatten(1, (-1, self.azimuths)).log_softmax(2)


def recogniser_network(recipe: RecogniserRecipe, classes: int, azimuths: int) -> ResNet | LiteNet:
    """The network of a recipe, untrained; ``azimuths`` azimuth bins are told apart, if any."""
    channels = CHANNELS_OF[recipe.input]
    if recipe.network == "lite0":
        return LiteNet(classes, channels, azimuths, recipe.dropout)
    return ResNet(recipe.depth, classes, channels, azimuths)


class PointLayer(nn.Module):
    """The same fully connected layer, with batch norm over all points, for every point of clouds (B, P, inputs)."""

    def __init__(self, inputs: int, outputs: int, relu: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.linear(x).flatten(0, 1)).unflatten(0, x.shape[:2])
        return torch.relu(x) if self.relu else x


class Transform(nn.Module):
    """T-Net: a k x k matrix from a cloud of k-dimensional points (B, P, k), beginning as the identity."""

    def __init__(self, k: int) -> None:
        super().__init__()
        self.k = k
        self.points = nn.Sequential(PointLayer(k, 64), PointLayer(64, 128), PointLayer(128, 1024))
        self.head = nn.Sequential(
            nn.Linear(1024, 512), nn.BatchNorm1d(512), nn.ReLU(inplace=True),
            nn.Linear(512, 256), nn.BatchNorm1d(256), nn.ReLU(inplace=True),
        )  # fmt: skip
        self.matrix = nn.Linear(256, k * k)
        nn.init.zeros_(self.matrix.weight)
        with torch.no_grad():
            self.matrix.bias.copy_(torch.eye(k).flatten())

    def forward(self, x: Tensor) -> Tensor:
        return self.matrix(self.head(self.points(x).amax(1))).unflatten(1, (self.k, self.k))


class PointNet(nn.Module):
    """PointNet (Qi et al., CVPR 2017) that predicts a map of rings x columns values from a cloud (B, P, 3) in [0, 1].

    ``forward`` returns the map (B, rings, columns) and the two transforms, (B, 3, 3) and (B, 64, 64).
    """

    def __init__(self, rings: int, columns: int = 3, dropout: float = 0.3) -> None:
        super().__init__()
        self.input_transform = Transform(3)
        self.first = PointLayer(3, 64)
        self.feature_transform = Transform(64)
        self.second = PointLayer(64, 128)
        self.third = PointLayer(128, 1024, relu=False)
        self.head = nn.Sequential(
            nn.Linear(1024, 512), nn.BatchNorm1d(512), nn.ReLU(inplace=True),
            nn.Linear(512, 256), nn.Dropout(dropout), nn.BatchNorm1d(256), nn.ReLU(inplace=True),
            nn.Linear(256, rings * columns),
        )  # fmt: skip
        # A ReLU whose input begins below zero stays dead: begin inside the range of the targets.
        nn.init.constant_(self.head[-1].bias, 0.5)
        self.shape = (rings, columns)

    def forward(self, cloud: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a = self.input_transform(cloud)
        x = self.first(torch.bmm(cloud, a))
        b = self.feature_transform(x)
        x = self.third(self.second(torch.bmm(x, b))).amax(1)
        return torch.relu(self.head(x)).unflatten(1, self.shape), a, b


class ViewMap(nn.Module):
    """A ResNet that predicts a map of rings x columns values in 0 .. 1 from a view, (B, channels, H, W) in 0 .. 1.

    ``forward`` returns the map (B, rings, columns), alone in a tuple.
    """

    def __init__(self, rings: int, columns: int, depth: int, channels: int) -> None:
        super().__init__()
        self.resnet, self.shape = ResNet(depth, rings * columns, channels), (rings, columns)

    def forward(self, view: Tensor) -> tuple[Tensor]:
        return (self.resnet(view)[0].sigmoid().unflatten(1, self.shape),)


def map_network(recipe: MapRecipe, sphere: ViewSphere) -> nn.Module:
    """The network of a recipe, untrained. The columns of its map are ``map_columns``."""
    columns = len(map_columns(recipe, sphere))
    if recipe.input == "cloud":
        return PointNet(sphere.rings, columns)
    network = ViewMap(sphere.rings, columns, recipe.depth, CHANNELS_OF[recipe.input])
    return network.to(memory_format=torch.channels_last)


def map_columns(recipe: MapRecipe, sphere: ViewSphere) -> list[int]:
    """Azimuth steps from the view to each column of a map: -1, 0, +1, or 0, 1, ... once round."""
    return [-1, 0, 1] if recipe.output == "window" else list(range(sphere.azimuths))


def orthogonality(matrix: Tensor) -> Tensor:
    """How far matrices (B, k, k) are from orthogonal: mean Frobenius norm of I - A A^T (thesis, equation 2)."""
    gram = torch.bmm(matrix, matrix.transpose(1, 2))
    eye = torch.eye(matrix.shape[1], device=matrix.device)
    return (gram - eye).flatten(1).norm(dim=1).mean()
