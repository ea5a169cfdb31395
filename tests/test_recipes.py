"""A recipe of training that makes no sense is refused when it is made, in a sentence that names the option."""

import re

import pytest

from nextview.cli.main import main
from nextview.errors import UsageError
from nextview.training.recipes import AgentRecipe, GainRecipe, MapRecipe, RecogniserRecipe


@pytest.mark.parametrize(
    ("kind", "options", "sentence"),
    [
        (RecogniserRecipe, {"network": "lite0", "depth": 34}, "only a ResNet has a --depth"),
        (RecogniserRecipe, {"dropout": 0.2}, "only EfficientNet-Lite0 drops features"),
        (RecogniserRecipe, {"network": "lite0", "dropout": 1.0}, "--dropout is 0 or more and less than 1, not 1.0"),
        (RecogniserRecipe, {"validation": float("nan")}, "--validation is 0 or more and less than 1, not nan"),
        (RecogniserRecipe, {"deformed_share": 1.5}, "--deformed-share is a chance, from 0 to 1, not 1.5"),
        (RecogniserRecipe, {"way": 0.0}, "--way is more than 0 and at most 1, not 0.0"),
        (RecogniserRecipe, {"epochs": 0}, "--epochs is at least 1, not 0"),
        (RecogniserRecipe, {"weight_decay": -1.0}, "--weight-decay is at least 0, not -1.0"),
        (MapRecipe, {"points": 1025}, "--points is a whole number from 0 to 1024, not 1025"),
        (MapRecipe, {"sharpness": 0.0}, "--sharpness is more than 0, not 0.0"),
        (MapRecipe, {"lr": float("inf")}, "--lr is a number of at most 100, not inf"),
        (MapRecipe, {"batch": 2.5}, "--batch is a whole number from 0 to 1000000, not 2.5"),
        (RecogniserRecipe, {"size": 10**9}, "--size is a whole number from 0 to 4096, not 1000000000"),
        (RecogniserRecipe, {"network": "vgg"}, "--network is resnet, lite0, not 'vgg'"),
        (RecogniserRecipe, {"augment": 1}, "--augment is true or false, not 1"),
        (RecogniserRecipe, {"lr": "fast"}, "--lr is a number, not 'fast'"),
        (AgentRecipe, {"exploration": (0.9,)}, "the two numbers of --exploration are from 0 to 1"),
        (AgentRecipe, {"envs": 10**6, "rollout": 10**6}, "--envs times --rollout is from 2 to 10,000,000"),
        (AgentRecipe, {"seed": 2**32}, "--seed is a whole number from 0 to 4294967295"),
        (GainRecipe, {"inputs": ("belief", 7)}, "--inputs are names, not 7"),
        (GainRecipe, {"n_views": 1}, "--n-views is at least 2, not 1"),
        (GainRecipe, {"inputs": ()}, "--inputs names at least one"),
    ],
)
def test_a_recipe_that_makes_no_sense_is_refused(kind, options, sentence):
    with pytest.raises(UsageError, match=re.escape(sentence)):
        kind(**options)


def test_the_command_refuses_such_a_recipe_before_it_looks_for_the_store(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["train", "recogniser", str(tmp_path / "no.zarr"), str(tmp_path / "run"), "--epochs", "0"])
    assert end.value.code == 2
    assert "--epochs is at least 1, not 0" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
