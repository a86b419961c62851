"""Malformed calls: each is refused by name and rule before work starts."""

import time

import pytest

from tests.bad_calls import attacks, control, data, defence, layer, proofs, sets, systems

ROOMS = {
    "data": data,
    "layer": layer,
    "sets": sets,
    "attacks": attacks,
    "control": control,
    "defence": defence,
    "systems": systems,
    "proofs": proofs,
}
CALLS = [(f"{room}: {call.label}", call) for room, module in ROOMS.items() for call in module.calls()]
AT_ONCE = 0.5  # seconds of processor time: before work starts


@pytest.mark.parametrize("call", [pytest.param(call, id=name) for name, call in CALLS])
@pytest.mark.filterwarnings("ignore")
def test_a_malformed_call_is_named(call):
    start = time.process_time()
    with pytest.raises((ValueError, TypeError)) as error:
        call.run()
    assert type(error.value) in (ValueError, TypeError), "a subclass, not an argument that is named"
    message = str(error.value)
    assert call.is_named(message), message
    assert time.process_time() - start < AT_ONCE


def test_the_table_is_long():
    assert len({name for name, _ in CALLS}) >= 300
