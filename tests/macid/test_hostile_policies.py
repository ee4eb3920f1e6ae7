"""Whatever lies in a policy's two files, it is a policy that gives what is finite, or told of in one line."""

import io
import itertools
import json
import zipfile

import numpy as np
import pytest
from hostile_files import array_files, json_files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from macid import arrays, observation, policy
from macid.evaluate import lcf_bins, table_lcf, usual_period
from macid.files import UsageError

_RNG = np.random.default_rng(0)
_SIZES = (policy.FEATURES + 1, 3, policy.ACTIONS)
WEIGHTS = {}
for _number, (_rows, _columns) in enumerate(itertools.pairwise(_SIZES)):
    WEIGHTS[f"weight{_number}"] = _RNG.normal(size=(_rows, _columns)).astype(np.float32)
    WEIGHTS[f"bias{_number}"] = _RNG.normal(size=_columns).astype(np.float32)
RECIPE = {
    "name": "copo", "method": "copo", "level": 2, "seed": 0, "period": 0.1, "agent_steps": 1000, "inputs": "features",
    "lcf_mean": 0.25, "lcf_std": 0.1, "reward": {"distance": 10.0}, "curve": [{"agent_steps": 10, "reward": 0.5}],
}  # fmt: skip
SEEN = np.zeros(observation.SIZE)


def weights(**more):
    content = io.BytesIO()
    np.savez(content, **{**WEIGHTS, **more})
    return content.getvalue()


GOOD = weights(), json.dumps(RECIPE).encode()
files = st.tuples(array_files(WEIGHTS), st.just(GOOD[1])) | st.tuples(st.just(GOOD[0]), json_files(RECIPE))


def refusal(call, argument, kind):
    """The message of the error of `kind` that `call(argument)` raises; None where it raises none."""
    try:
        call(argument)
    except kind as error:
        return str(error)
    return None


def ends_well(folder, content):
    """Writes a policy's two files and uses it: whether it was taken. What is refused is told of in a line that names
    it."""
    path = folder / "theirs.npz"
    path.write_bytes(content[0])
    path.with_suffix(".json").write_bytes(content[1])
    told = refusal(policy.load_policy, str(path), UsageError)
    if told is not None:
        assert len(told.splitlines()) == 1 and told.isprintable() and "theirs" in told, told
        assert len(told) < 1500
        return False
    made = policy.load_policy(str(path))
    assert np.isfinite(made.action(SEEN, 0.5)).all()
    assert 0 < made.period <= 20 and usual_period(str(path)) == made.period
    for asked in (table_lcf, lcf_bins):
        told = refusal(asked, str(path), ValueError)  # of a method that nobody knows
        assert told is None or len(told.splitlines()) == 1
    return True


@given(content=files)
@settings(max_examples=500, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_a_policy_is_read_or_refused_in_one_line(tmp_path_factory, content):
    ends_well(tmp_path_factory.getbasetemp(), content)


@pytest.mark.slow
def test_twenty_thousand_policies_are_read_or_refused_in_one_line(tmp_path):
    ends = []

    @given(content=files)
    @settings(max_examples=20_000, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    def each(content):
        ends.append(ends_well(tmp_path, content))

    each()
    assert len(ends) >= 20_000 and any(ends) and not all(ends)
    print(f"{len(ends)} policies: {sum(ends)} were taken, {len(ends) - sum(ends)} refused")


def test_the_good_one_is_taken_and_its_finds_are_told(tmp_path):
    assert ends_well(tmp_path, GOOD)
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("weight0.npy", "w") as member:
        for _ in range(80):
            member.write(bytes(1 << 20))
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (43, 1000000000), }".ljust(117) + b"\n"
    declared = b"\x93NUMPY\x01\x00v\x00" + header
    large = io.BytesIO()
    with zipfile.ZipFile(large, "w") as archive:
        archive.writestr("weight0.npy", declared)
    narrow = weights(weight1=np.zeros((3, 1), np.float32), bias1=np.zeros(1, np.float32))
    odd = weights(weight1=np.zeros((4, 2), np.float32))
    deep = b'{"curve": ' + b"[" * 3000 + b"]" * 3000 + b"}"
    for content, told in (
        ((b"", GOOD[1]), "no sound zip file"),
        ((GOOD[0][:-30], GOOD[1]), "no sound zip file"),
        ((GOOD[0].replace(WEIGHTS["weight0"].tobytes()[:8], bytes(8), 1), GOOD[1]), "CRC"),
        ((bomb.getvalue(), GOOD[1]), "unpacks to 83,886,080 bytes; at most 67,108,864"),
        ((large.getvalue(), GOOD[1]), "declares 43x1000000000 numbers, but has 0 bytes"),
        ((weights(bias1=np.array([np.nan, 0], np.float32)), GOOD[1]), "bias1 holds nan"),
        ((odd, GOOD[1]), "layer 1 takes 4 numbers, but the one before gives 3"),
        ((narrow, GOOD[1]), "it gives 1 numbers, not 2"),
        ((weights(weight1=np.zeros((3, 2), int)), GOOD[1]), "not floats"),
        ((weights(other=np.zeros(2)), GOOD[1]), "'other' is odd"),
        ((GOOD[0], b""), "JSON"),
        ((GOOD[0], b"[]"), "a table of keys"),
        ((GOOD[0], b'{"period": "0.02"}'), "period"),
        ((GOOD[0], b'{"period": 0.03}'), "multiple"),
        ((GOOD[0], b'{"period": 1e308}'), "period"),
        ((GOOD[0], b'{"lcf_mean": NaN}'), "lcf_mean"),
        ((GOOD[0], b'{"inputs": "pixels"}'), "inputs"),
        ((GOOD[0], b'{"seed": 1' + b"0" * 400 + b"}"), "seed"),
        ((GOOD[0], deep), "deep"),
    ):
        path = tmp_path / "theirs.npz"
        assert not ends_well(tmp_path, content), told
        with pytest.raises(UsageError, match=told):
            policy.load_policy(str(path))
    path.with_suffix(".json").unlink()
    with pytest.raises(UsageError, match="no policy's recipe file .*theirs.json"):
        policy.load_policy(str(path))


def test_arrays_are_kept_as_they_are():
    kinds = [np.arange(6).reshape(2, 3), np.asfortranarray(_RNG.normal(size=(3, 4))), np.zeros((3, 0)), np.float32(2.5)]
    kinds += [np.array([True, False]), np.arange(3, dtype=np.uint64), np.arange(4, dtype=np.float16)]
    named = {f"a['{index}'].b": np.asarray(array) for index, array in enumerate(kinds)}
    noted = {"x": [1, 0.1, None, "é"], "y": {"z": True}}
    found, documents = arrays.unpack(io.BytesIO(arrays.pack(named, {"noted": noted})), 10**6)
    assert documents == {"noted": noted} and found.keys() == named.keys()
    for name, array in named.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype and found[name].flags.writeable
    with np.load(io.BytesIO(arrays.pack(named))) as loaded:
        assert all(np.array_equal(loaded[name], array) for name, array in named.items())
