"""The parts of the fields against plain twins: hash encoding, attention in segments, pixels, voxels in bricks."""

import numpy as np
import pytest
import torch
from tolerances import FLOAT32

from phyradgs_cl.errors import DeviceError, InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.neural import LineOptions, NeuralOptions
from phyradgs_cl.neural.field import (
    HashEncoding,
    LineAttention,
    corners,
    first_field,
    torch_device,
    voxel_values,
    weighted_rows,
)
from phyradgs_cl.neural.trainer import chosen_times, scattered_pixels, windows_and_scattered_pixels

CPU = torch.device("cpu")


def plain_encoding(encoding: HashEncoding, position: np.ndarray) -> np.ndarray:
    """Features of one position (3,), a corner at a time, with 64-bit whole numbers for the hash."""
    table = np.array(encoding.table.tolist())
    features, start = [], 0
    for cells, size in zip(encoding.resolutions, encoding.sizes, strict=True):
        low = np.minimum(np.floor(position * cells), cells - 1).astype(int)
        rest = position * cells - low
        total = np.zeros(encoding.features)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (int(n) for n in low + corner)
            if (cells + 1) ** 3 <= size:
                entry = x + y * (cells + 1) + z * (cells + 1) ** 2
            else:
                entry = (x ^ (y * 2654435761) ^ (z * 805459861)) % size
            total += table[start + entry] * np.prod(np.where(corner, rest, 1 - rest))
        features.append(total)
        start += size
    return np.concatenate(features)


def test_the_encoding_is_its_definition_and_so_is_its_gradient() -> None:
    encoding = HashEncoding(4, 2, 3, 2.0, 9).double()  # 4³ and 7³ entries, then two hashed levels
    assert encoding.sizes == [64, 343, 512, 512]
    with torch.no_grad():
        encoding.table.uniform_(-1, 1)
    rng = np.random.default_rng(0)
    positions = np.concatenate([rng.random((20, 3)), [[0, 0, 0], [1, 1, 1], [0.5, 1, 0]]])
    found = encoding(torch.tensor(positions))
    expected = [plain_encoding(encoding, x) for x in positions]
    assert np.allclose(found.tolist(), expected, atol=1e-12)
    # linear in the table: the gradient of <y, E(table)> is the transpose of E
    weights = torch.tensor(rng.normal(size=found.shape))
    (found * weights).sum().backward()
    direction = torch.tensor(rng.normal(size=encoding.table.shape))
    by_gradient = float((encoding.table.grad * direction).sum())
    with torch.no_grad():
        encoding.table.copy_(direction)
        by_definition = float((encoding(torch.tensor(positions)) * weights).sum())
    assert by_definition == pytest.approx(by_gradient, rel=1e-9)


def test_sums_without_the_fused_one_and_weights_of_corners() -> None:
    made = torch.Generator().manual_seed(0)
    table, weight = torch.rand(50, 3, generator=made), torch.rand(20, 8, generator=made)
    index = torch.randint(0, 50, (20, 8), generator=made)
    fused = torch.nn.functional.embedding_bag(index, table, mode="sum", per_sample_weights=weight)
    assert torch.allclose(weighted_rows(table, index, weight), fused, rtol=FLOAT32)
    positions = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    for cells, size in ((5, 216), (64, 1000)):
        entry, weight = corners(positions, cells, size)
        assert int(entry.min()) >= 0 and int(entry.max()) < size
        assert torch.allclose(weight.sum(0), torch.ones(1000)) and float(weight.min()) >= 0


def test_attention_stays_within_segments_and_is_its_definition() -> None:
    torch.manual_seed(0)
    segment, heads, head_width, width = 3, 2, 4, 6
    layer = LineAttention(width, segment, heads, head_width).double()
    values = torch.randn(4 * segment, width, dtype=torch.float64)
    found = layer(values)
    q, kv = layer.to_query(values), layer.to_key_value(values)
    expected = torch.empty(len(values), heads * head_width, dtype=torch.float64)
    for first in range(0, len(values), segment):
        rows = slice(first, first + segment)
        for head in range(heads):
            part = slice(head * head_width, (head + 1) * head_width)
            key, value = kv[rows, : heads * head_width][:, part], kv[rows, heads * head_width :][:, part]
            likeness = q[rows, part] @ key.T / head_width**0.5 + layer.position[head]
            expected[rows, part] = torch.softmax(likeness, 1) @ value
    assert torch.allclose(found, layer.to_output(expected), atol=1e-12)
    values[0] += 1.0
    changed = (layer(values) != found).any(1)
    assert changed[:segment].all() and not changed[segment:].any()


FIELDS = {"naf": NeuralOptions(), "two layers": NeuralOptions(layers=2), "sax-nerf": LineOptions(segment=4)}


@pytest.mark.parametrize("options", FIELDS.values(), ids=FIELDS)
def test_bricks_of_voxels_do_not_matter_and_voxels_lie_where_the_grid_says(options) -> None:
    field = first_field(options, 16, 0)
    grid = Grid((3, 5, 6), (0.2, 0.2, 0.3))  # half the longest side is 0.9
    grid = grid.scaled(1 / grid.half_longest_mm)
    whole = voxel_values(field, grid, CPU, 10**6)
    assert whole.shape == grid.shape and whole.dtype == np.float32
    assert np.allclose(whole, voxel_values(field, grid, CPU, 1), rtol=FLOAT32)
    means = voxel_values(field, grid, CPU, 10**6, 3)
    assert means.shape == grid.shape
    assert np.allclose(means, voxel_values(field, grid, CPU, 1, 3), rtol=FLOAT32)

    class Position(torch.nn.Module):
        segment = options.__dict__.get("segment", 1)

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return x[:, 0] + 10 * x[:, 1] + 100 * x[:, 2]

    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    for points in (1, 2, 3):  # of a linear field, the mean over a voxel is its value at the centre
        found = voxel_values(Position(), grid, CPU, 20, points)
        assert np.allclose(found, x + 10 * y + 100 * z, atol=1e-4)


def test_a_volume_does_not_depend_on_how_its_axes_are_called() -> None:
    """Attention couples neighbours, and voxels are to have them along every axis alike."""
    field = first_field(LineOptions(), 8, 0)
    with torch.no_grad():
        field.encoding.table.uniform_(-1, 1, generator=torch.Generator().manual_seed(0))

    class Renamed(torch.nn.Module):
        segment = field.segment

        def forward(self, positions: torch.Tensor) -> torch.Tensor:
            return field(positions[:, [1, 2, 0]])  # its x is the field's z, its y the field's x

    grid = Grid((2, 4, 6), (1 / 3, 1 / 3, 1 / 3))
    found = voxel_values(Renamed(), Grid((4, 6, 2), grid.voxel_size_mm), CPU, 1000)  # y, x, z of the field's
    expected = voxel_values(field, grid, CPU, 1000)
    assert np.allclose(found.transpose(2, 0, 1), expected, rtol=1e-5)
    assert expected.std() > 0.01 * expected.mean()


def test_the_field_starts_at_its_share_of_the_bound_and_leaves_others_draws_alone() -> None:
    positions = torch.rand(100, 3) * 2 - 1
    for share in (0.05, 0.5):
        options = NeuralOptions(first_share=share, density_bound=4.0)
        values = first_field(options, 16, 1)(positions).detach()
        assert float(values.mean()) == pytest.approx(4 * share, rel=0.5) and float(values.max()) < 4
    leaky = first_field(NeuralOptions(last_activation="leaky-relu"), 16, 1)
    assert float(leaky(positions).detach().min()) > -1
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first_field(LineOptions(), 16, 1)
    assert torch.equal(torch.rand(3), expected)


def test_pixels_and_times_are_drawn_evenly_and_each_once() -> None:
    rng = np.random.default_rng(0)
    usable = rng.random((9, 7)) < 0.5
    pixels = scattered_pixels(usable, 20, rng)
    assert len(np.unique(pixels, axis=0)) == len(pixels) == 20
    assert usable[tuple(pixels.T)].all()
    assert len(scattered_pixels(usable, 1000, rng)) == usable.sum()
    assert scattered_pixels(np.zeros((3, 3), bool), 4, rng).shape == (0, 2)
    times = chosen_times(20_000, 5, 2, np.random.default_rng(0))
    assert np.all(times[:, 0] != times[:, 1])
    assert np.allclose(np.bincount(times.ravel(), minlength=5) / times.size, 0.2, atol=0.01)
    assert np.array_equal(chosen_times(2, 3, 3, np.random.default_rng(0)), [[0, 1, 2]] * 2)


def test_windows_are_whole_and_favour_no_pixel_and_the_scattered_pixels_lie_outside_them() -> None:
    """Every pixel is as likely as any other, so that windows change a step's noise and not what it fits."""
    rng = np.random.default_rng(0)
    usable = np.ones((17, 14), bool)
    usable[5, 5] = False
    pixels = windows_and_scattered_pixels(usable, 30, 3, 4, rng)
    assert len(pixels) == 3 * 16 + 30 == len(np.unique(pixels, axis=0))
    local = pixels[:48].reshape(3, 16, 2)
    for window in local:
        low = window.min(0)
        assert np.all(low % 4 == 0) and np.all(window.max(0) == low + 3)
    assert usable[tuple(pixels.T)].all()
    every = windows_and_scattered_pixels(usable, 10_000, 100, 4, rng)
    assert len(every) == usable.sum()
    rng, usable, counts = np.random.default_rng(0), np.ones((16, 12), bool), np.zeros((16, 12))
    for _ in range(4000):
        counts[tuple(windows_and_scattered_pixels(usable, 40, 2, 4, rng).T)] += 1
    likely = (40 + 2 * 16) / usable.size
    assert np.abs(counts / 4000 - likely).max() < 5 * np.sqrt(likely * (1 - likely) / 4000)


def test_devices_and_options_that_do_not_go_together() -> None:
    assert torch_device("cpu") == CPU
    missing = [name for name in ("cuda", "mps") if not getattr(torch, name).is_available()]
    for name in missing:
        with pytest.raises(DeviceError, match=f"torch_device: found no {name} in PyTorch"):
            torch_device(name)
    assert torch_device("auto").type in {"cuda", "mps", "cpu"}
    with pytest.raises(InputError, match="levels: found a finest level"):
        NeuralOptions(levels=32)
    assert NeuralOptions().samples_for(64) == 96
    assert [NeuralOptions().levels_for(n) for n in (4, 64, 100, 128)] == [1, 4, 5, 5]
    assert NeuralOptions(levels=3).levels_for(64) == 3 and NeuralOptions(level_growth=1.0).levels_for(64) == 1
    assert NeuralOptions().samples_for(128) == 192 and NeuralOptions().samples_for(128, 5) == 154
    assert LineOptions(segment=5).samples_for(64) == 100
