from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.kernels.coding.range_coder import code_bit, consumed, decoder, encoder, finish, mix_bit, mixer
from nerfbake.kernels.coding.tables import SQUASH, STRETCH

decisions = st.lists(st.tuples(st.integers(1, 65535), st.integers(0, 1)), max_size=400)


def coded(pairs: list[tuple[int, int]]) -> bytes:
    coder = encoder(4096)
    for p, bit in pairs:
        code_bit(coder, p, bit)
    return bytes(coder.data[: finish(coder)])


def test_one_decision_by_hand() -> None:
    # The upper three quarters are a 0: low = 0x3fffffff, and the first byte that lies in the interval is 0x40.
    assert coded([(1 << 14, 0)]) == b"\x40"
    assert coded([(1 << 14, 1)]) == b"\x00"
    assert coded([]) == b"\x00"


@given(decisions)
def test_what_was_coded_is_decoded_and_no_byte_is_left(pairs: list[tuple[int, int]]) -> None:
    data = coded(pairs)
    coder = decoder(np.frombuffer(data, np.uint8))
    assert [code_bit(coder, p, 0) for p, _ in pairs] == [bit for _, bit in pairs]
    assert consumed(coder) == len(data)


def test_a_carry_runs_through_all_bytes_of_ones() -> None:
    # Each 0 of probability 65535/65536 for a 1 moves low up to the end of its interval; a last 0 carries.
    pairs = [(65535, 0)] + [(1, 0)] * 3000 + [(65535, 0), (32768, 0)] * 20
    coder = decoder(np.frombuffer(coded(pairs), np.uint8))
    assert [code_bit(coder, p, 0) for p, _ in pairs] == [bit for _, bit in pairs]


def test_bytes_are_as_many_as_the_probabilities_say() -> None:
    random = np.random.default_rng(1)
    p = random.choice([300, 5000, 32768, 64000], 40_000)
    bits = random.random(len(p)) < p / 65536
    expected = -np.log2(np.where(bits, p, 65536 - p) / 65536).sum() / 8
    assert len(coded(list(zip(p.tolist(), bits.tolist(), strict=True)))) == pytest.approx(expected, rel=1e-3)


def test_an_encoder_without_room_says_how_much_it_needs() -> None:
    coder, wide = encoder(10), encoder(4096)
    for each in (coder, wide):
        for _ in range(1000):
            code_bit(each, 20000, 1)
    assert finish(coder) == finish(wide) > 10


@pytest.mark.parametrize("p", [0.5, 0.1, 0.01])
def test_mixed_models_come_within_a_tenth_of_the_entropy(p: float) -> None:
    random = np.random.default_rng(2)
    bits = (random.random(50_000) < p).astype(int).tolist()
    coder, models = encoder(len(bits)), mixer(4, 1)
    for bit in bits:
        mix_bit(coder, models, 0, 0, 1, 2, 3, bit)
    share = sum(bits) / len(bits)
    entropy = -(share * np.log2(share) + (1 - share) * np.log2(1 - share))
    assert 8 * finish(coder) / len(bits) == pytest.approx(entropy, rel=0.1)


def test_a_model_that_knows_is_heard() -> None:
    """Of four models one sees the bit that it is to predict: it costs next to nothing once the weights have learnt."""
    bits = np.random.default_rng(3).integers(0, 2, 20_000).tolist()
    coder, models = encoder(len(bits)), mixer(2, 1)
    for bit in bits:
        mix_bit(coder, models, 0, 0, 1, bit, 0, bit)
    assert 8 * finish(coder) / len(bits) < 0.02


def test_the_tables_are_the_logistic_function_and_its_inverse() -> None:
    x = np.arange(-2047, 2048)
    exact = 65536 / (1 + np.exp(-x / 256))
    assert np.abs(SQUASH[1:] - exact).max() < 200
    assert (np.diff(SQUASH[1:]) >= 0).all()
    assert (SQUASH.min(), SQUASH.max()) == (22, 65514)
    q = np.arange(4096)
    assert (SQUASH[STRETCH + 2048] >= np.minimum(16 * q + 8, 65514)).all()
    assert (SQUASH[STRETCH + 2047] < 16 * q + 8)[STRETCH > -2047].all()
