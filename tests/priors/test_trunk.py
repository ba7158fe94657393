"""The trunk of EfficientNet-Lite0: reading it, its features, and what is wrong with a file."""

import numpy as np
import pytest
import torch

from priors import trunk as writer
from priors.pictures import seen_in
from reconstruction.core.trunk import CHANNELS, WEIGHTS, Trunk, load_trunk
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage


def test_a_trunk_of_pytorch_is_read_with_its_normalization_folded_in(tmp_path):
    torch.manual_seed(0)
    stored = {}
    for name, shape, norm in [
        ("_conv_stem", (32, 3, 3, 3), "_bn0"), ("_blocks.0._depthwise_conv", (32, 1, 3, 3), "_blocks.0._bn1"),
    ]:  # fmt: skip
        stored[f"{name}.weight"] = torch.randn(shape)
        stored |= {
            f"{norm}.{k}": torch.rand(shape[0]) + 0.5
            for k in ("weight", "bias", "running_mean", "running_var")
        }
    torch.save(stored, tmp_path / "lite0.pth")
    with pytest.raises(UsageError, match=r"no EfficientNet-Lite0 .*_blocks"):
        writer.read_trunk(tmp_path / "lite0.pth")
    x = torch.rand(1, 3, 8, 8)
    plain = torch.nn.functional.conv2d(
        torch.nn.functional.pad(x, (0, 1, 0, 1)), stored["_conv_stem.weight"], stride=2
    )
    norm = [stored[f"_bn0.{k}"] for k in ("running_mean", "running_var", "weight", "bias")]
    wanted = torch.nn.functional.batch_norm(plain, *norm, eps=1e-3)
    stem = Trunk().stem
    writer.fold(stem, stored, "_conv_stem", "_bn0")
    torch.testing.assert_close(stem(x), wanted, atol=1e-4, rtol=1e-4)


def test_what_is_written_is_what_was_read(tmp_path):
    torch.manual_seed(0)
    trunk, stored = Trunk(), {}

    def put(convolution, name, norm):
        shape = convolution.weight.shape
        stored[f"{name}.weight"] = torch.randn(shape)
        stored.update({f"{norm}.{k}": torch.rand(shape[0]) + 0.5 for k in ("weight", "bias", "running_var")})
        stored[f"{norm}.running_mean"] = torch.randn(shape[0])

    put(trunk.stem, "_conv_stem", "_bn0")
    for number, block in enumerate(trunk.blocks):
        there = [kind for kind in ("expand", "depthwise", "project") if getattr(block, kind) is not None]
        for layer, kind in enumerate(there, start=3 - len(there)):
            put(getattr(block, kind), f"_blocks.{number}._{kind}_conv", f"_blocks.{number}._bn{layer}")
    torch.save(stored, tmp_path / "lite0.pth")
    assert writer.main([str(tmp_path / "lite0.pth"), "--out", str(tmp_path / "trunk.safetensors")]) == 0
    read, again = writer.read_trunk(tmp_path / "lite0.pth"), load_trunk(tmp_path / "trunk.safetensors")
    for (name, a), b in zip(read.state_dict().items(), again.state_dict().values(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4, err_msg=name)


def test_a_file_that_is_no_trunk_is_one_error(tmp_path, capsys):
    (tmp_path / "x.pth").write_bytes(b"nothing")
    with pytest.raises(SystemExit):
        writer.main([str(tmp_path / "x.pth")])
    assert "no EfficientNet-Lite0" in capsys.readouterr().err
    with pytest.raises(EnvironmentMissing, match="Install the package again"):
        load_trunk(tmp_path / "none.safetensors")


@pytest.mark.parametrize("size", [(240, 320), (61, 83)])
def test_features_halve_the_picture_and_know_what_is_in_it(size):
    color = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    found = seen_in(color)
    h, w = size
    for channels, features in zip(CHANNELS, found, strict=True):
        h, w = -(-h // 2), -(-w // 2)
        assert features.shape == (1, channels, h, w)
    assert not any(features.requires_grad for features in found)
    other = seen_in(1 - color)
    assert all((a - b).abs().mean() > 0.01 for a, b in zip(found, other))


def test_the_trunk_is_small():
    assert WEIGHTS.stat().st_size < 1.5e6
