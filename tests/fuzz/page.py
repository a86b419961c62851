"""The page of the documentation that tells what the fuzz found."""

from scripts.shared.command import versions

PAGE = """# Random problems against an independent reference

`make fuzz` solves random problems with the layer and with a reference that shares no code with it, and counts where
they part. {versions}.

{table}
{held_out}
What is left sits in units that differ between channels, where coefficients cancel by ten digits and more: curved sets
that end as FAILED, and the rare g of double precision that does not reproduce its plan. Undecided are mostly plans that
the layer proves and the reference does not reach. Each finding is in `results/fuzz/failures.txt` with the call that
replays it.

## The problems

Recordings of random systems with 1 to 4 inputs and 1 to 6 outputs, with noise from 0 to 1e-2, of one or several
pieces, some with too few windows, an idle or doubled input, a dead or doubled output; every set and term of the
layer; weights over ten decades; units of 1e-6 to 1e6, one for all channels or one for each. A quarter as many again
are *sensible*: one unit system, definite weights, usual regularisation. A problem is made from its stream and index
alone, so any of them can be replayed:

    python -c "from tests.fuzz.run import run; print(run('any', 322))"

## The reference

`tests/oracles` takes the problem as it is posed: the Hankel matrices of the recording, weights and sets in the user's
units.

1. Channels are brought to one scale. Singular value decompositions give the row space, a QR in long double the null
   space of the equalities and the triangle of the cost.
2. Feasibility is the least violation of the sets: a linear program (HiGHS), or a conic one (Clarabel) where sets
   are curved.
3. Clarabel comes near the optimum. An active set in long double finishes it; on curved sets each step is one of
   Newton's.
4. Duality proves the result: multipliers that the sets admit bound the cost of *every* plan from below. The bound
   holds whoever found them.

A plan that is returned as solved is *wrong* if, in long double and on the recorded matrices,

- a row of Up g = u_ini, u = Uf g, y = Yf g misses by more than 1e-6 of its channel, or a set by as much, or
- its cost exceeds the proven bound by more than 1e-6 of it, beyond what rounding excuses (references missed by 1e-7
  of a channel, initial outputs by 1e-10), and the reference holds a better plan.

A sample is called falsely infeasible only if the reference holds a plan inside the sets to 1e-12 of each channel.
Where the rank of the recording is a matter of opinion (a singular value between 1e-13 and 1e-8 of the largest), a
difference is counted as undecided."""


HELD_OUT = """
A held-out stream, `--stream {stream}`, none of whose problems was looked at before:

{table}
"""


def page(table: str, held_out: tuple[str, str] | None = None) -> str:
    """Return the page with a table, and with that of a held-out stream, given as its name and table."""
    made = versions(1, 1).split("; seeds")[0]
    other = "" if held_out is None else HELD_OUT.replace("{stream}", held_out[0]).replace("{table}", held_out[1])
    whole = PAGE.replace("{versions}", f"One run with {made}").replace("{table}", table)
    return whole.replace("{held_out}", other)
