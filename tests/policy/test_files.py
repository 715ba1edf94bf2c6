"""A policy on file loads without trust: damage and ill will are named, and nothing grows."""

import json
import tempfile
from collections.abc import Sequence
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
def intact(tmp_path_factory):
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


def test_every_character_of_the_json_counts_but_blanks(intact):
    for place in range(len(TEXT)):
        text = bytearray(TEXT)
        text[place] ^= 1
        assert not still_loads(intact, bytes(text), DATA), text[place - 10 : place + 10]


@settings(max_examples=200)
@given(part=st.floats(0, 1, exclude_max=True), more=st.binary(min_size=1, max_size=100))
def test_files_cut_off_anywhere_or_followed_by_anything_are_refused(intact, part, more):
    assert not still_loads(intact, TEXT[: int(part * len(TEXT))], DATA)
    assert not still_loads(intact, TEXT, DATA[: int(part * len(DATA))])
    assert not still_loads(intact, TEXT, DATA + more)
    still_loads(intact, TEXT + more, DATA)  # it may be blanks


def test_weights_of_another_policy_are_refused(tmp_path):
    changed = {name: values + 1 for name, values in WEIGHTS.items()}
    with pytest.raises(PolicyFileError, match="not that in the JSON"):
        load_policy(write_raw(tmp_path, TEXT, safetensors.numpy.save(changed)))


@pytest.mark.parametrize("name", ["p.json", "p.safetensors"])
def test_a_file_of_a_terabyte_is_refused_before_it_is_read(tmp_path, name):
    write(tmp_path)
    with (tmp_path / name).open("r+b") as file:
        file.truncate(1 << 40)  # sparse: it takes no room
    with pytest.raises(PolicyFileError, match=rf"{name}: .* {1 << 40} bytes"):
        load_policy(tmp_path / "p")


# -- ill will: files whose sums are right ----------------------------------------------------------


def put(path: Sequence[Any], value: Any) -> dict[str, Any]:
    """Return the JSON with one entry replaced or added."""
    content = described(DATA)
    *parents, last = path
    place = content
    for key in parents:
        place = place[key]
    place[last] = value
    return content


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("format", "pickle"),
        ("version", 2),
        ("network.features.kind", "eval"),
        ("network.features.unit", 0),
        ("network.features", {"kind": "concatenate", "keys": ["observation"]}),
        ("network.features.keys", ["observation", "observation", "achieved_goal", "desired_goal"]),
        ("network.hidden", [0] * 100_000),
        ("network.activation", "exec"),
        ("env_options", {"eval": "x"}),
        ("env", "TPMReach-v0\n\x1b[31m"),
        ("seed", -1),
        ("observation_space", {}),
        ("observation_space.desired_goal.shape", [-1]),
        ("observation_space.desired_goal", box(2, 1.0)),
        ("observation_space.observation.dtype", "object"),
        ("observation_space.observation.low", [11.0] * 4),
        ("action_space.low", [-1.0]),
        ("weights.bytes", 10**9),
        ("weights.file", "/etc/passwd"),
    ],
)
def test_entries_that_cannot_be_are_refused(tmp_path, path, value):
    with pytest.raises(PolicyFileError, match="is not a policy file: ") as caught:
        load_policy(write(tmp_path, put(path.split("."), value)))
    assert caught.value.path.startswith(str(tmp_path / "p"))
    assert str(caught.value).isprintable()
    assert len(caught.value.reason) < 1000


def test_a_gap_is_between_two_goals(tmp_path):
    content = put(["observation_space"], {"observation": box(4, 10.0)})
    content["network"]["features"]["keys"] = ["observation"]
    with pytest.raises(PolicyFileError, match="needs an observation and two goals"):
        load_policy(write(tmp_path, content))


def test_no_entry_may_be_missing(tmp_path):
    for key in set(described(DATA)) - {"env_options"}:
        content = described(DATA)
        del content[key]
        with pytest.raises(PolicyFileError, match=f"{key}: Field required"):
            load_policy(write(tmp_path, content))


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"\xff\xfe",
        b"[" * 500_000,
        b'{"a":' * 150_000,
        TEXT.replace(b"5000", b"NaN", 1),
        TEXT.replace(b"0.95", b"NaN", 1),
        TEXT.replace(b"0.95", b"1e999", 1),
        TEXT.replace(b"0.05", b"1e999", 1),
        TEXT.replace(b"0.95", b"[" * 400 + b"]" * 400, 1),
        TEXT.replace(b"5000", b"9" * 100_000, 1),
        TEXT.replace(b'"seed"', b'"steps"', 1),
        b"[]",
        TEXT.replace(b"5000", b"5001", 1),
        b" " * (policy_file.MAX_JSON + 1),
    ],
    ids=lambda text: ascii(text[:20]),
)
def test_json_that_describes_no_policy_is_refused(tmp_path, text):
    with pytest.raises(PolicyFileError, match="is not a policy file: "):
        load_policy(write_raw(tmp_path, text))


def test_the_layout_of_the_json_does_not_matter(tmp_path):
    intact = load_policy(write(tmp_path))
    content = json.loads(TEXT)
    text = json.dumps(dict(reversed(content.items())), separators=(",", ":"))
    assert same(load_policy(write_raw(tmp_path, text.encode())), intact)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": np.zeros(1, np.float32)}, "not those of the network"),
        ({"layers.1.bias": None}, "not those of the network"),
        ({"layers.0.weight": WEIGHTS["layers.0.weight"].T.copy()}, "not those of the network"),
        ({"layers.0.bias": WEIGHTS["layers.0.bias"].astype(np.float64)}, "finite float32"),
        ({"layers.2.bias": np.array([0, np.nan], np.float32)}, "finite float32"),
        ({"layers.2.bias": np.array([0, -np.inf], np.float32)}, "finite float32"),
    ],
)
def test_tensors_are_exactly_those_of_the_network(tmp_path, changes, message):
    tensors = {name: values for name, values in (WEIGHTS | changes).items() if values is not None}
    data = safetensors.numpy.save(tensors)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(write(tmp_path, described(data), data))


def assert_refused_or_a_policy(content: dict[str, Any], data: bytes) -> None:
    """It either acts, finitely, or is refused with words."""
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), content, data)
        try:
            actions, told = load_policy(path).act(observations(2)), ""
        except PolicyFileError as refusal:
            actions, told = np.zeros((2, 2)), str(refusal)
    assert np.isfinite(actions).all()
    assert actions.shape == (2, 2)
    assert told.isprintable()


@settings(max_examples=300)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, len(DATA) - 1), st.integers(0, 255)), min_size=1, max_size=4
    ),
    header_only=st.booleans(),
)
def test_weights_of_an_ill_willed_author_are_refused_or_finite(changes, header_only):
    data = bytearray(DATA)
    header = len(DATA) - 4 * sum(values.size for values in WEIGHTS.values())
    for place, value in changes:
        data[place % header if header_only else place] = value
    assert_refused_or_a_policy(described(bytes(data)), bytes(data))
