"""Mutants of the compiled kernels."""

from .mutant import Mutant as M

INTERVALS, NEWTON, SOLUTION = (f"torch_dpc/solve/_{name}.h" for name in ("primal_dual", "newton", "solution"))
BOXES, SETS = "solve/test_kernels.py", "solve/test_kernel_sets.py"

MUTANTS = [
    M(
        "kernel: a row is above its bound too late",
        INTERVALS,
        "upper + slack_at(p->settings, upper)",
        "upper + 1e-3",
        BOXES + " -k random_boxes",
    ),
    M(
        "kernel: tight rows may be let go",
        INTERVALS,
        "const int is_tight = lower == upper; /* always held */",
        "const int is_tight = 0;",
        BOXES,
    ),
    M(
        "kernel: multipliers beyond the price",
        INTERVALS,
        "w->lam[i] = w->side[i] > 0 ? w->price[i] : -w->price[i];",
        "w->lam[i] = w->side[i] > 0 ? 2 * w->price[i] : -w->price[i];",
        SETS + " -k random_sets or priced",
    ),
    M(
        "kernel: a ball of twice the radius",
        "torch_dpc/solve/_sets.h",
        "const double fraction = distance > radius ? (1.0 - radius / distance) / gamma : 0.0;",
        "const double fraction = distance > radius ? (1.0 - 0.5 * radius / distance) / gamma : 0.0;",
        SETS + " -k random_sets",
    ),
    M(
        "kernel: a cone's apex is missed",
        "torch_dpc/solve/_sets.h",
        "if (distance <= -head) of_head = of_rest = 1.0 / gamma;",
        "if (distance <= -2.0 * head) of_head = of_rest = 1.0 / gamma;",
        SETS + " -k random_sets",
    ),
    M(
        "kernel: stationarity is not judged",
        SOLUTION,
        "verdict->missed[i] = fabs(raw[i] - v) / (1.0 + fabs(v));",
        "verdict->missed[i] = 0.0;",
        SETS + " -k judgement",
    ),
    M(
        "kernel: blocks are not judged",
        SOLUTION,
        "verdict->missed[i] = fabs(raw[i] - verdict->v[i]) / (1.0 + largest);",
        "verdict->missed[i] = 0.0;",
        SETS + " -k judgement",
    ),
    M(
        "kernel: weak rows are active",
        SOLUTION,
        "verdict->active[i] = !verdict->weak[i] && is_row_held",
        "verdict->active[i] = is_row_held",
        SETS + " -k judgement",
    ),
    M("kernel: a weak block is held", SOLUTION, "if (is_weak) c->state[b] = OFF;", "", SETS + " -k weak_block"),
    M(
        "kernel: gamma forgotten where v is pushed",
        SOLUTION,
        "c->pushed[i] = v[i] + c->gamma[i] * lam[i];",
        "c->pushed[i] = v[i] + lam[i];",
        SETS + " -k operator",
    ),
]
