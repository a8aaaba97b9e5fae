"""A mask that swells for one frame is cut down; one that grows is not."""

import numpy as np

from mjx_refine.observe.spikes import cut_spikes


def disc(size: tuple[int, int], centre: tuple[float, float], radius: float) -> np.ndarray:
    rows, columns = np.mgrid[: size[0], : size[1]]
    return (columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 < radius**2


def clip(radii: list[float]):
    """Green discs that fall over a grey background: (true masks, pictures)."""
    masks = np.stack([disc((80, 60), (30, 20 + 3 * t), radius) for t, radius in enumerate(radii)])
    frames = np.where(masks[..., None], [20, 150, 40], [180, 180, 180]).astype(np.uint8)
    return masks.astype(int), frames


def test_a_reflection_is_cut_off():
    truth, frames = clip([9.0] * 12)
    masks = truth.copy()
    masks[6] |= disc((80, 60), (30, 52), 8)
    frames[6][(masks[6] > 0) & (truth[6] == 0)] = [90, 60, 40]
    cleaned, cut = cut_spikes(masks, frames)
    assert cut == 1
    both = np.count_nonzero((cleaned[6] > 0) & (truth[6] > 0))
    assert both / np.count_nonzero((cleaned[6] > 0) | (truth[6] > 0)) > 0.85
    untouched = np.arange(12) != 6
    np.testing.assert_array_equal(cleaned[untouched], masks[untouched])


def test_an_object_that_comes_nearer_is_left_alone():
    masks, frames = clip([6.0 + 0.9 * t for t in range(12)])
    cleaned, cut = cut_spikes(masks, frames)
    assert cut == 0
    np.testing.assert_array_equal(cleaned, masks)


def test_a_mask_seen_in_one_frame_alone_is_left_alone():
    masks, frames = clip([9.0] * 3)
    masks[[0, 2]] = 0
    assert cut_spikes(masks, frames)[1] == 0
