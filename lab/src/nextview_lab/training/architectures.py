"""The networks: ResNet (torchvision's names), EfficientNet-Lite0, PointNet, map ResNet, U-Net."""

from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.network_input import CHANNELS_OF
from nextview.segmentation.features import PICTURE_CHANNELS
from nextview.segmentation.network import OUTPUTS
from nextview_lab.extras import extras
from nextview_lab.training.recipes import MapRecipe, RecogniserRecipe

with extras():
    import torch
    from torch import Tensor, nn
    from torch.nn import functional as F

# expansion, width, kernel, stride and blocks (Tan and Le, EfficientNet, ICML 2019, table 1)
NETWORK_STAGES = (
    (1, 16, 3, 1, 1),
    (6, 24, 3, 2, 2),
    (6, 40, 5, 2, 2),
    (6, 80, 3, 2, 3),
    (6, 112, 5, 1, 3),
    (6, 192, 5, 2, 4),
    (6, 320, 3, 1, 1),
)
BLOCKS = sum(length for *_, length in NETWORK_STAGES)
FEATURE_CHANNELS = 1280


class Depthwise(nn.Conv2d):
    """Depthwise convolution, always in float32, because its bfloat16 gradient is slow on a CPU."""

    def __init__(self, width: int, kernel: int, stride: int) -> None:
        super().__init__(
            width,
            width,
            kernel,
            stride,
            kernel // 2,
            groups=width,
            bias=False,
        )

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


class InvertedBottleneck(nn.Module):
    """Expansion, depthwise convolution, projection; with a shortcut if the shape is unchanged."""

    def __init__(
        self,
        inputs: int,
        expansion: int,
        width: int,
        kernel: int,
        stride: int,
        skip: float = 0.0,
    ) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = (
            nn.Conv2d(inputs, wide, 1, bias=False) if expansion > 1 else nn.Identity()
        )
        self.norm0 = _norm(wide) if expansion > 1 else nn.Identity()
        self.depthwise = Depthwise(wide, kernel, stride)
        self.norm1 = _norm(wide)
        self.project = nn.Conv2d(wide, width, 1, bias=False)
        self.norm2 = _norm(width)
        self.relu = nn.ReLU6(inplace=True)
        self.expands = expansion > 1
        self.has_shortcut = stride == 1 and inputs == width
        self.skip = skip

    def forward(self, x: Tensor) -> Tensor:
        past = x
        if self.expands:
            x = self.relu(self.norm0(self.expand(x)))
        x = self.relu(self.norm1(self.depthwise(x)))
        x = self.norm2(self.project(x))
        if not self.has_shortcut:
            return x
        if self.training and self.skip:
            x = (
                x
                * (torch.rand(len(x), 1, 1, 1, device=x.device) >= self.skip)
                / (1 - self.skip)
            )
        return x + past


class RecogniserNetwork(nn.Module):
    """Network from images, (B, channels, H, W) in 0 to 1, to logits, (B, classes), in a tuple.

    With ``azimuths``, it also returns the log-likelihoods of this number of azimuth bins given each
    class, (B, classes, azimuths).
    """

    dropout = 0.0

    def finish(self, features: int, classes: int, azimuths: int) -> None:
        """Add the last layers and draw the initial weights of all convolutions.

        Args:
            features: number of features before the last layers.
            classes: number of classes.
            azimuths: number of azimuth bins; 0 for none.
        """
        self.avgpool = nn.AdaptiveAvgPool2d(1)
        self.fc = nn.Linear(features, classes)
        self.azimuths = azimuths
        self.side = nn.Linear(features, classes * azimuths) if azimuths else None
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(
                    module.weight,
                    mode="fan_out",
                    nonlinearity="relu",
                )

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        return self.answers(self.features(x))

    def answers(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs of ``forward`` for features, (B, F)."""
        features = F.dropout(features, self.dropout, self.training)
        logits = self.fc(features)
        if self.side is None:
            return (logits,)
        return logits, self.side(features).unflatten(
            1,
            (-1, self.azimuths),
        ).log_softmax(2)


class LiteNet(RecogniserNetwork):
    """EfficientNet-Lite0: B0 without squeeze and excitation, with ReLU6 (TensorFlow, 2020)."""

    name = "EfficientNet-Lite0"

    def __init__(
        self,
        classes: int,
        channels: int,
        azimuths: int = 0,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.dropout = dropout
        inputs = 32
        self.stem = nn.Conv2d(channels, inputs, 3, 2, 1, bias=False)
        self.norm0 = _norm(inputs)

        stages: list[nn.Module] = []
        for expansion, width, kernel, stride, length in NETWORK_STAGES:
            for index in range(length):
                step = 1 if index else stride
                skip = dropout * len(stages) / BLOCKS
                stages.append(
                    InvertedBottleneck(inputs, expansion, width, kernel, step, skip)
                )
                inputs = width
        self.stages = nn.Sequential(*stages)

        self.head = nn.Conv2d(inputs, FEATURE_CHANNELS, 1, bias=False)
        self.norm1 = _norm(FEATURE_CHANNELS)
        self.relu = nn.ReLU6(inplace=True)
        self.finish(FEATURE_CHANNELS, classes, azimuths)

    def features(self, x: Tensor) -> Tensor:
        """Compute features of images, (B, F)."""
        x = self.stages(self.relu(self.norm0(self.stem(x))))
        return self.avgpool(self.relu(self.norm1(self.head(x)))).flatten(1)


def _norm(width: int) -> nn.BatchNorm2d:
    # EfficientNet's epsilon, as in published checkpoints
    return nn.BatchNorm2d(width, eps=1e-3)


RESNETS = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}
"""Blocks in the four stages of each ResNet (He et al., CVPR 2016, table 1)."""


class Residual(nn.Module):
    """A shortcut around two 3x3 convolutions, or if ``narrow``, around 1x1, 3x3 and 1x1."""

    def __init__(self, inputs: int, width: int, stride: int, narrow: bool) -> None:
        super().__init__()
        self.relu = nn.ReLU(inplace=True)
        outputs = width * (4 if narrow else 1)
        kernels = [(3, width, stride), (3, width, 1)]
        if narrow:
            kernels = [(1, width, 1), (3, width, stride), (1, outputs, 1)]

        self.length = len(kernels)
        before = inputs
        for k, (kernel, after, step) in enumerate(kernels, 1):
            self.add_module(
                f"conv{k}",
                nn.Conv2d(before, after, kernel, step, kernel // 2, bias=False),
            )
            self.add_module(f"bn{k}", nn.BatchNorm2d(after))
            before = after

        self.downsample = None
        if stride > 1 or inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False),
                nn.BatchNorm2d(outputs),
            )

    def forward(self, x: Tensor) -> Tensor:
        past = x if self.downsample is None else self.downsample(x)
        for k in range(1, self.length + 1):
            x = getattr(self, f"bn{k}")(getattr(self, f"conv{k}")(x))
            x = self.relu(x + past if k == self.length else x)
        return x


class ResNet(RecogniserNetwork):
    """A ResNet with torchvision's parameter names."""

    def __init__(
        self,
        depth: int,
        classes: int,
        channels: int,
        azimuths: int = 0,
    ) -> None:
        super().__init__()
        self.name = f"ResNet-{depth}"
        narrow = depth >= 50
        self.conv1 = nn.Conv2d(channels, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        inputs = 64
        for stage, length in enumerate(RESNETS[depth]):
            layer = []
            for index in range(length):
                layer.append(
                    Residual(
                        inputs,
                        64 << stage,
                        2 if stage and not index else 1,
                        narrow,
                    )
                )
                inputs = (64 << stage) * (4 if narrow else 1)
            setattr(self, f"layer{stage + 1}", nn.Sequential(*layer))
        self.finish(inputs, classes, azimuths)
        # each block starts as the identity, which stabilises large learning rates
        for module in self.modules():
            if isinstance(module, Residual):
                nn.init.zeros_(getattr(module, f"bn{module.length}").weight)

    def features(self, x: Tensor) -> Tensor:
        """Compute features of images, (B, F)."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
        return self.avgpool(x).flatten(1)


def recogniser_network(
    recipe: RecogniserRecipe,
    classes: int,
    azimuths: int,
) -> ResNet | LiteNet:
    """Create the untrained network of a recipe.

    Args:
        recipe: the recipe.
        classes: number of classes.
        azimuths: number of azimuth bins; 0 for none.

    Returns:
        The network.
    """
    channels = CHANNELS_OF[recipe.input]
    if recipe.network == "lite0":
        return LiteNet(classes, channels, azimuths, recipe.dropout)
    return ResNet(recipe.layers, classes, channels, azimuths)


def _dense(between: tuple[nn.Module, ...]) -> nn.Sequential:
    """Return the fully connected layers after pooling over the points of a cloud."""
    first = (nn.Linear(1024, 512), nn.BatchNorm1d(512))
    second = (nn.Linear(512, 256), *between, nn.BatchNorm1d(256))
    return nn.Sequential(*first, nn.ReLU(inplace=True), *second, nn.ReLU(inplace=True))


class PointLayer(nn.Module):
    """A fully connected layer with batch norm for every point of clouds, (B, P, inputs)."""

    def __init__(self, inputs: int, outputs: int, relu: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.linear(x).flatten(0, 1)).unflatten(0, x.shape[:2])
        return torch.relu(x) if self.relu else x


class Transform(nn.Module):
    """A T-Net: a k x k matrix from a cloud, (B, P, k), that starts as the identity."""

    def __init__(self, k: int) -> None:
        super().__init__()
        self.k = k
        self.points = nn.Sequential(
            PointLayer(k, 64),
            PointLayer(64, 128),
            PointLayer(128, 1024),
        )
        self.head = _dense(())
        self.matrix = nn.Linear(256, k * k)
        nn.init.zeros_(self.matrix.weight)
        with torch.no_grad():
            self.matrix.bias.copy_(torch.eye(k).flatten())

    def forward(self, x: Tensor) -> Tensor:
        return self.matrix(self.head(self.points(x).amax(1))).unflatten(
            1,
            (self.k, self.k),
        )


class PointNet(nn.Module):
    """PointNet (Qi et al., CVPR 2017): a map, rings x columns, from a cloud, (B, P, 3)."""

    def __init__(self, rings: int, columns: int = 3, dropout: float = 0.3) -> None:
        super().__init__()
        self.input_transform = Transform(3)
        self.first = PointLayer(3, 64)
        self.feature_transform = Transform(64)
        self.second = PointLayer(64, 128)
        self.third = PointLayer(128, 1024, relu=False)
        self.head = _dense((nn.Dropout(dropout),)).append(
            nn.Linear(256, rings * columns)
        )
        # Start inside the range of the targets, as a ReLU with negative input has no gradient.
        nn.init.constant_(self.head[-1].bias, 0.5)
        self.shape = (rings, columns)

    def forward(self, cloud: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a = self.input_transform(cloud)
        x = self.first(torch.bmm(cloud, a))
        b = self.feature_transform(x)
        x = self.third(self.second(torch.bmm(x, b))).amax(1)
        return torch.relu(self.head(x)).unflatten(1, self.shape), a, b


class ViewMap(nn.Module):
    """A ResNet that predicts a map, rings x columns in 0 to 1, from a view.

    The view is (B, channels, H, W) in 0 to 1.
    """

    def __init__(self, rings: int, columns: int, depth: int, channels: int) -> None:
        super().__init__()
        self.resnet = ResNet(depth, rings * columns, channels)
        self.shape = (rings, columns)

    def forward(self, view: Tensor) -> tuple[Tensor]:
        return (self.resnet(view)[0].sigmoid().unflatten(1, self.shape),)


def map_network(recipe: MapRecipe, sphere: ViewSphere) -> nn.Module:
    """Create the untrained map network of a recipe; its columns are ``map_columns``.

    Args:
        recipe: the recipe.
        sphere: the viewpoints of the maps.

    Returns:
        The network.
    """
    columns = len(map_columns(recipe, sphere))
    if recipe.input == "cloud":
        return PointNet(sphere.rings, columns)
    network = ViewMap(sphere.rings, columns, recipe.layers, CHANNELS_OF[recipe.input])
    return network.to(memory_format=torch.channels_last)


def map_columns(recipe: MapRecipe, sphere: ViewSphere) -> list[int]:
    """Return the azimuth steps from the view to each column of a map.

    Args:
        recipe: of the network.
        sphere: the viewpoints of the maps.

    Returns:
        -1, 0, +1 for a window; 0, 1, ... once around for the whole sphere.
    """
    return [-1, 0, 1] if recipe.extent == "window" else list(range(sphere.azimuths))


def orthogonality(matrix: Tensor) -> Tensor:
    """Return the deviation of matrices, (B, k, k), from orthogonality.

    It is the mean Frobenius norm of I - A A^T (thesis, equation 2).
    """
    gram = torch.bmm(matrix, matrix.transpose(1, 2))
    return (
        (gram - torch.eye(matrix.shape[1], device=matrix.device))
        .flatten(1)
        .norm(dim=1)
        .mean()
    )


class Convolutions(nn.Module):
    """Two convolutions with a shortcut."""

    def __init__(self, inputs: int, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.a = _normed(inputs, width, dilation)
        self.b = _normed(width, width, dilation)
        self.r = nn.Identity() if inputs == width else nn.Conv2d(inputs, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.b(F.relu(self.a(x))) + self.r(x))


def _normed(inputs: int, width: int, dilation: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, width, 3, padding=dilation, dilation=dilation, bias=False),
        nn.BatchNorm2d(width),
    )


class SegmentationNet(nn.Module):
    """A U-Net that works at half the resolution of its input; see ``SegmentationCard``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.e1 = Convolutions(4 * PICTURE_CHANNELS, width)
        self.e2 = Convolutions(width, 2 * width)
        self.e3 = Convolutions(2 * width, 3 * width)
        self.e4 = Convolutions(3 * width, 4 * width)
        self.e5 = Convolutions(4 * width, 4 * width, 2)
        self.d3 = Convolutions(7 * width, 3 * width)
        self.d2 = Convolutions(5 * width, 2 * width)
        self.d1 = Convolutions(3 * width, width)
        self.o = nn.Conv2d(width, 4 * OUTPUTS, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.e1(F.pixel_unshuffle(x, 2))
        middle = self.e2(F.max_pool2d(fine, 2))
        coarse = self.e3(F.max_pool2d(middle, 2))
        deepest = self.e5(self.e4(F.max_pool2d(coarse, 2)))
        coarse = self.d3(torch.cat([_twice(deepest), coarse], 1))
        middle = self.d2(torch.cat([_twice(coarse), middle], 1))
        fine = self.d1(torch.cat([_twice(middle), fine], 1))
        return F.pixel_shuffle(self.o(fine), 2)


def _twice(x: Tensor) -> Tensor:
    """Upsample an image to twice as many rows and columns."""
    return F.interpolate(x, scale_factor=2, mode="nearest")
