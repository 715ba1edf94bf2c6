"""A policy on file loads without trust: damage and ill will are named, and nothing grows."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_on_file import (
    DATA,
    TEXT,
    WEIGHTS,
    Weights,
    box,
    described,
    observations,
    same,
    write,
    write_raw,
)

from tpm_gym.errors import PolicyFileError
from tpm_gym.policy import files as policy_file
from tpm_gym.policy.policy import Policy, load_policy

# -- damage ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    return load_policy(write(tmp_path_factory.mktemp("intact")))


def still_loads(intact: Policy, text: bytes, data: bytes) -> bool:
    """Whether damaged files still load; if so, it has to be the same policy."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_raw(Path(folder), text, data)
        try:
            damaged = load_policy(path)
        except PolicyFileError:
            return False
    assert same(intact, damaged)
    return True


@settings(max_examples=300, deadline=None)
@given(place=st.integers(0, len(TEXT) - 1), value=st.integers(0, 255))
def test_any_byte_of_the_json_may_be_damaged(intact: Policy, place: int, value: int) -> None:
    text = bytearray(TEXT)
    text[place] = value
    still_loads(intact, bytes(text), DATA)


def test_every_character_of_the_json_counts_but_blanks(intact: Policy) -> None:
    for place in range(len(TEXT)):
        text = bytearray(TEXT)
        text[place] ^= 1
        assert not still_loads(intact, bytes(text), DATA), text[place - 10 : place + 10]


@settings(max_examples=300, deadline=None)
@given(place=st.integers(0, len(DATA) - 1), mask=st.integers(1, 255))
def test_any_byte_of_the_weights_counts(intact: Policy, place: int, mask: int) -> None:
    data = bytearray(DATA)
    data[place] ^= mask
    assert not still_loads(intact, TEXT, bytes(data))


@settings(max_examples=200, deadline=None)
@given(cut=st.integers(0, len(TEXT) - 1))
def test_a_json_cut_off_anywhere_is_refused(intact: Policy, cut: int) -> None:
    assert not still_loads(intact, TEXT[:cut], DATA)


@settings(max_examples=100, deadline=None)
@given(cut=st.integers(0, len(DATA) - 1))
def test_weights_cut_off_anywhere_are_refused(intact: Policy, cut: int) -> None:
    assert not still_loads(intact, TEXT, DATA[:cut])


@settings(max_examples=50, deadline=None)
@given(more=st.binary(min_size=1, max_size=100))
def test_nothing_may_follow(intact: Policy, more: bytes) -> None:
    assert not still_loads(intact, TEXT, DATA + more)
    still_loads(intact, TEXT + more, DATA)


def test_cut_off_and_swapped_weights_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(PolicyFileError, match=f"cut off: 100 bytes of {len(DATA)}"):
        load_policy(write_raw(tmp_path, TEXT, DATA[:100]))
    changed = {name: values + 1 for name, values in WEIGHTS.items()}
    with pytest.raises(PolicyFileError, match="of another policy"):
        load_policy(write_raw(tmp_path, TEXT, safetensors.numpy.save(changed)))


@pytest.mark.parametrize("name", ["p.json", "p.safetensors"])
def test_a_file_of_a_terabyte_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    write(tmp_path)
    with (tmp_path / name).open("r+b") as file:
        file.truncate(1 << 40)  # sparse: it takes no room
    with pytest.raises(PolicyFileError, match=rf"{name}: is too large: {1 << 40} bytes"):
        load_policy(tmp_path / "p")


# -- ill will: files whose sums are right ----------------------------------------------------------


def put(path: str, value: Any) -> dict[str, Any]:
    """Return the JSON with one entry replaced or added, dotted path."""
    content = described(DATA)
    *parents, last = path.split(".")
    place: Any = content
    for key in parents:
        place = place[key]
    place[last] = value
    return content


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("format", "pickle", "does not describe a policy"),
        ("version", 2, "format version 2"),
        ("version", True, "format version True"),
        ("version", [[[[]]]], "format version"),
        ("extra", 1, "an object with the keys"),
        ("network.extra", 1, "entry network must be an object with the keys features"),
        ("network.features.keys", [], "entry network.features must be an object with the keys"),
        ("network.features.kind", "eval", "one of concatenate, goal_gap"),
        ("network.features.unit", 0, "entry network.features.unit must be a number"),
        ("network.features.unit", True, "entry network.features.unit must be a number"),
        ("network.features", {"kind": "concatenate", "keys": ["observation"]}, "all keys"),
        ("network.features", {"kind": "concatenate", "keys": ["a"] * 99}, "at most 16"),
        ("network.features", "goal_gap", "entry network.features must be an object"),
        ("network.hidden", [4096] * 21, "at most 20 entries"),
        ("network.hidden", [4097], r"network.hidden\[0\] must be an integer from 1 to 4096"),
        ("network.hidden", [0], r"network.hidden\[0\]"),
        ("network.hidden", [5.0, 4], r"network.hidden\[0\] must be an integer .*not 5.0"),
        ("network.hidden", [4096] * 20, "at most 67108864 bytes"),
        ("network.hidden", [5, 4, 3000], "entry weights.bytes must be an integer from"),
        ("network.activation", "exec", "one of relu, tanh"),
        ("network.output", ["tanh"], "one of tanh, clip"),
        ("algorithm", "dqn", "one of sac, tqc, ppo"),
        ("env", "TPMReach-v0\n\x1b[31m", "entry env must be text"),
        ("env", "x" * 10000, "entry env must be text .{1,200}$"),
        ("seed", -1, "entry seed must be an integer"),
        ("seed", "0", "entry seed must be an integer"),
        ("seed", True, "entry seed must be an integer .*not True"),
        ("steps", None, "entry steps must be an integer"),
        ("recipe", [], "entry recipe must be an object"),
        ("recipe", {str(i): 0 for i in range(65)}, "entry recipe must be an object"),
        ("versions.torch", 2, "entry versions.torch must be text"),
        ("versions.torch", "\ud800\n", "entry versions.torch must be text"),
        ("observation_space", {}, "suits the observation"),
        ("observation_space.desired_goal.shape", [4], "low must be a list of 4 numbers"),
        ("observation_space.desired_goal", box(2, 1.0), "suits the observation"),
        ("observation_space.observation.shape", [4096, 4096], "at most 4096 entries in all"),
        ("observation_space.observation.shape", [1] * 5, "at most 4 entries"),
        ("observation_space.observation.dtype", "object", "one of float32, float64"),
        ("observation_space.observation.low", [11.0] * 4, "low must be nowhere above high"),
        ("observation_space.observation.low", [-1e31] * 4, "a number from -1e"),
        ("observation_space.../../x", box(1, 1.0), "keys that match"),
        ("action_space.low", [-1.0], "a list of 2 numbers"),
        ("action_space.shape", [], "must be a list of at most 1 entries"),
        ("weights.bytes", 10**9, "entry weights.bytes must be an integer"),
        ("weights.bytes", 10, "entry weights.bytes must be an integer"),
        ("weights.sha256", "A" * 64, "entry weights.sha256 must be text"),
        ("weights.file", "/etc/passwd", "entry weights must be an object"),
    ],
)
def test_entries_that_cannot_be_are_named(
    tmp_path: Path, path: str, value: Any, message: str
) -> None:
    parts = path.replace("../../x", "").split(".") if "/" in path else []
    content = put(path, value) if not parts else described(DATA)
    if parts:
        content["observation_space"]["../../x"] = value
    with pytest.raises(PolicyFileError, match=message) as caught:
        load_policy(write(tmp_path, content))
    assert caught.value.path == str(tmp_path / "p.json")
    assert str(caught.value).isprintable()
    assert len(caught.value.reason) < 300


@pytest.mark.parametrize("key", sorted(described(DATA)))
def test_no_entry_may_be_missing(tmp_path: Path, key: str) -> None:
    content = described(DATA)
    del content[key]
    with pytest.raises(PolicyFileError):
        load_policy(write(tmp_path, content))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "no valid JSON"),
        (b"\xff\xfe", "no valid JSON"),
        (b"\xef\xbb\xbf" + TEXT, "no valid JSON"),
        (TEXT.decode().encode("utf-16"), "no valid JSON"),
        (b"[" * 500_000, "nested too deeply"),
        (b'{"a":' * 150_000, "nested too deeply"),
        (b"[" * 40 + b"]" * 40, "nested too deeply"),
        (TEXT.replace(b"5000", b"NaN", 1), "NaN is not JSON"),
        (TEXT.replace(b"0.95", b"-Infinity", 1), "-Infinity is not JSON"),
        (TEXT.replace(b"0.95", b"1e999", 1), "too large"),
        (TEXT.replace(b"5000", b"9" * 100_000, 1), "too large"),
        (TEXT.replace(b'"seed"', b'"steps"', 1), "a key stands twice"),
        (b"[]", "does not describe a policy"),
        (b"3", "does not describe a policy"),
        (TEXT.replace(b"5000", b"5001", 1), "edited by hand"),
        (b" " * (policy_file.MAX_JSON + 1), "too large"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_json_that_only_python_would_read_is_refused(
    tmp_path: Path, text: bytes, message: str
) -> None:
    with pytest.raises(PolicyFileError, match=message) as caught:
        load_policy(write_raw(tmp_path, text))
    assert len(str(caught.value.reason)) < 300


def test_the_layout_of_the_json_does_not_matter(tmp_path: Path) -> None:
    intact = load_policy(write(tmp_path))
    content = json.loads(TEXT)
    text = json.dumps(dict(reversed(content.items())), separators=(",", ":"))
    assert same(load_policy(write_raw(tmp_path, text.encode())), intact)


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({**WEIGHTS, "x": np.zeros(1, np.float32)}, r"'x' is \('F32', \(1,\)\), not None"),
        ({n: v for n, v in WEIGHTS.items() if n != "layers.1.bias"}, "'layers.1.bias' is None"),
        (
            {**WEIGHTS, "layers.0.weight": WEIGHTS["layers.0.weight"].T.copy()},
            r"'layers.0.weight' is .*\(7, 5\).* not .*\(5, 7\)",
        ),
        (
            {**WEIGHTS, "layers.0.bias": WEIGHTS["layers.0.bias"].astype(np.float64)},
            "'layers.0.bias' is .*F64",
        ),
        ({**WEIGHTS, "layers.0.bias": np.zeros(5, np.int32)}, "'layers.0.bias' is .*I32"),
        ({**WEIGHTS, "layers.2.bias": np.array([0, np.nan], np.float32)}, "is not finite"),
        ({**WEIGHTS, "layers.2.bias": np.array([0, -np.inf], np.float32)}, "is not finite"),
    ],
)
def test_tensors_are_exactly_those_of_the_network(
    tmp_path: Path, tensors: Weights, message: str
) -> None:
    data = safetensors.numpy.save(tensors)
    content = described(data)
    content["weights"]["bytes"] = len(data)
    needed = 4 * sum(values.size for values in WEIGHTS.values())
    if len(data) < needed:
        pytest.fail("the case would be refused for its size")
    with pytest.raises(PolicyFileError, match=message):
        load_policy(write(tmp_path, content, data))


@settings(max_examples=300, deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, len(DATA) - 1), st.integers(0, 255)), min_size=1, max_size=4
    ),
    header_only=st.booleans(),
)
def test_weights_of_an_ill_willed_author_are_refused_or_finite(
    changes: list[tuple[int, int]], header_only: bool
) -> None:
    data = bytearray(DATA)
    header = len(DATA) - 4 * sum(values.size for values in WEIGHTS.values())
    for place, value in changes:
        data[place % header if header_only else place] = value
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), described(bytes(data)), bytes(data))
        try:
            found = load_policy(path)
        except PolicyFileError as refusal:
            error = refusal
        else:
            assert found.act(observations(2)).shape == (2, 2)
            return
    assert str(error).isprintable()


JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**19), 10**19)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5)
    | st.sampled_from(["kind", "relu", "clip", "goal_gap", "concatenate"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


def places(value: Any, before: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to every value inside a value."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for key, inner in items:
        found.append((*before, key))
        if isinstance(inner, dict | list):
            found += places(inner, (*before, key))
    return found


@settings(max_examples=300, deadline=None)
@given(place=st.sampled_from(places(described(DATA))), value=JSON_VALUES)
def test_json_of_an_ill_willed_author_is_refused_or_a_policy(
    place: tuple[Any, ...], value: Any
) -> None:
    content = described(DATA)
    inner: Any = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), content)
        try:
            found = load_policy(path)
        except PolicyFileError as refusal:
            error = refusal
        else:
            assert found.act(observations(2)).shape == (2, 2)
            return
    assert str(error).isprintable()
