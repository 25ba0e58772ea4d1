"""SAM 2's memory bank: what a frame attends to, by the definition, and what may be forgotten."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.networks.sam2.bank import (
    POINTERS,
    Bank,
    Memory,
    forget,
    from_bfloat16,
    pointers,
    spatial_memories,
    to_bfloat16,
)

SLOTS = 7


def memory(t):
    return Memory(np.full((2, 3), t, np.uint16), np.full(4, t, np.float32))


def bank_of(conditioning, tracked):
    return Bank({t: memory(t) for t in conditioning}, {t: memory(t) for t in tracked})


def test_the_six_frames_before_and_every_prompted_frame_are_attended_to():
    bank = bank_of([0, 40], range(1, 20))
    assert [(row, int(m[0, 0])) for row, m in spatial_memories(bank, 20, 1, slots=SLOTS)] == [
        (6, 0),
        (6, 40),
        *[(5, 14), (4, 15), (3, 16), (2, 17), (1, 18), (0, 19)],
    ]
    backward = bank_of([10], [5, 6, 7, 8, 9, 11, 12, 13])  # frame 10 is prompted: it has the last row alone
    assert [(row, int(m[0, 0])) for row, m in spatial_memories(backward, 4, -1, slots=SLOTS)] == [
        (6, 10),
        *[(4, 9), (3, 8), (2, 7), (1, 6), (0, 5)],
    ]
    just_turned = spatial_memories(backward, 9, -1, slots=SLOTS)  # what the forward pass left beyond the prompt
    assert [(row, int(m[0, 0])) for row, m in just_turned] == [(6, 10), (3, 13), (2, 12), (1, 11)]


def test_pointers_are_those_behind_and_the_nearest_fifteen():
    bank = bank_of([3, 30], range(4, 25))
    found = [(distance, int(p[0])) for distance, p in pointers(bank, 25, 1, count=100)]
    assert found == [(22, 3), *[(d, 25 - d) for d in range(1, POINTERS)]]
    short = [distance for distance, _ in pointers(bank, 25, 1, count=5)]
    assert short == [22, 1, 2, 3, 4]
    assert [d for d, _ in pointers(bank_of([10], range(5, 10)), 4, -1, count=20)] == [6, 1, 2, 3, 4, 5]


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(2, 60),
    start=st.integers(0, 59),
    prompted=st.sets(st.integers(0, 59), min_size=1, max_size=4),
)
def test_what_is_forgotten_was_never_to_be_read(count, start, prompted):
    start = min(start, count - 1)
    prompted = {min(t, count - 1) for t in prompted}
    whole, kept = bank_of(prompted, []), bank_of(prompted, [])
    for step, order in ((1, range(start, count)), (-1, range(start - 1, -1, -1))):
        for t in order:
            if t in prompted:
                continue
            for read, options in ((spatial_memories, {"slots": SLOTS}), (pointers, {"count": count})):
                wanted, found = read(whole, t, step, **options), read(kept, t, step, **options)
                assert [(d, float(m.flat[0])) for d, m in found] == [(d, float(m.flat[0])) for d, m in wanted]
            whole = whole.with_tracked(t, memory(t))
            kept = forget(kept.with_tracked(t, memory(t)), t, step, slots=SLOTS, turn=start if step == 1 else None)
            assert sum(m.spatial is not None for m in kept.tracked.values()) <= 2 * (SLOTS - 1)
            assert len(kept.tracked) <= 2 * (POINTERS - 1)


def test_reading_what_was_forgotten_is_an_error():
    bank = bank_of([0], [1, 2, 3])
    bank = Bank(bank.conditioning, bank.tracked | {2: dataclasses.replace(memory(2), spatial=None)})
    with pytest.raises(ValueError, match="forgotten"):
        spatial_memories(bank, 4, 1, slots=SLOTS)


def test_bfloat16_is_rounded_as_jax_rounds_it():
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(size=5000) * 10.0 ** rng.integers(-20, 20, 5000), [0.0, -0.0, 1.00390625]])
    values = values.astype(np.float32)
    np.testing.assert_array_equal(
        from_bfloat16(to_bfloat16(values)), np.asarray(jnp.asarray(values).astype(jnp.bfloat16).astype(jnp.float32))
    )
