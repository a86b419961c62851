"""The layer: its arguments, its settings, its call, its files."""

import torch

import torch_dpc as dpc
from helpers import SMALL, randn, small_data, small_layer, windows

from .entry import INF, NAN, NEGATIVE, Call, each, one

DATA = small_data()  # t_ini 3, horizon 6, 2 inputs, 4 outputs
U_INI, Y_INI = windows(1, 3)
U_INI, Y_INI = U_INI[0], Y_INI[0]


def layer(**options):
    return dpc.DPCLayer(DATA, **{**SMALL, **options})


def call(**options):
    arguments = {"u_ini": U_INI, "y_ini": Y_INI, **options}
    return small_layer()(arguments.pop("u_ini"), arguments.pop("y_ini"), **arguments)


def asymmetric(n):
    return torch.eye(n) + torch.ones(n, n).triu(1)


def no_weight(n):
    """Values that are no weight of n channels."""
    shapes = (torch.eye(n + 1), torch.ones(n + 1, n), torch.ones(n), torch.eye(n).long(), torch.full((n, n), NAN))
    return (-1.0, NAN, INF, "a", 1j, {}, -torch.eye(n), asymmetric(n), *shapes)


NO_SET = (3, "a", dpc.Box, [dpc.Box(-1.0, 1.0)], (-1.0, 1.0), torch.ones(2), True)
NO_WINDOW = (
    None,
    "a",
    3.0,
    {},
    randn(3, 7),
    randn(2, 2),
    randn(7),
    torch.zeros(3, 2, dtype=torch.int64),
    torch.full((3, 2), NAN),
    torch.full((3, 4), NAN),
    [[1.0], [1.0, 2.0]],
)


def setting(name, value):
    """Assign a setting, and call: what does not go together is told at the call."""
    made = small_layer()
    setattr(made, name, value)
    return made(U_INI, Y_INI)


def calls() -> list[Call]:
    """Return the table."""
    return [
        *each("data", "data", (None, 3, "a", DATA.Up, [DATA], small_layer(), {}), lambda d: dpc.DPCLayer(d, **SMALL)),
        *each("Q", "Q", (None, *no_weight(4)), lambda w: layer(Q=w)),
        *each("R", "R", (None, *no_weight(2)), lambda w: layer(R=w)),
        *each("R_du", "R_du", no_weight(2), lambda w: layer(R_du=w)),
        *each("lambda_g", "lambda_g", NEGATIVE, lambda w: layer(lambda_g=w)),
        *each("lambda_s", "lambda_s", NEGATIVE, lambda w: layer(lambda_s=w)),
        *each("lambda_u", "lambda_u", (-1.0, NAN, INF, "a", {}), lambda w: layer(lambda_u=w)),
        *one("lambda_u", "lambda_u and R_du", lambda: layer(lambda_u=1.0, R_du=1.0)),
        *one("lambda_u", "lambda_u and du_set", lambda: layer(lambda_u=1.0, du_set=dpc.Box(-1.0, 1.0))),
        *each("u_set", "u_set", NO_SET, lambda s: layer(u_set=s)),
        *each("y_set", "y_set", NO_SET, lambda s: layer(y_set=s)),
        *each("du_set", "du_set", NO_SET, lambda s: layer(du_set=s)),
        *each(
            "u_set",
            "u_set of another size",
            (
                dpc.Box(-torch.ones(3), torch.ones(3)),
                dpc.Box(0.0, torch.ones(5, 2)),
                dpc.Ball(1.0, torch.zeros(3)),
                dpc.Ball(torch.ones(5)),
                dpc.Product([(dpc.Ball(1.0), [0])]),
                dpc.Product([(dpc.Ball(1.0), [0, 1, 2])]),
                dpc.SoftBox(-1.0, 1.0, torch.ones(3)),
            ),
            lambda s: layer(u_set=s)(U_INI, Y_INI),
        ),
        *each("regularizer", "regularizer", ("l1", None, 3, True), lambda r: layer(regularizer=r)),
        *each("terminal_steps", "terminal_steps", (-1, 1.5, "2", True, None, 7), lambda n: layer(terminal_steps=n)),
        *each("backward", "backward", ("half", None, 3), lambda b: layer(backward=b)),
        *each("solver", "solver", ("osqp", None, 3), lambda s: layer(solver=s)),
        *each("on_failure", "on_failure", ("ignore", None, 3), lambda f: layer(on_failure=f)),
        *each("u_ini", "call u_ini", NO_WINDOW, lambda w: call(u_ini=w)),
        *each("y_ini", "call y_ini", NO_WINDOW, lambda w: call(y_ini=w)),
        *each(
            "y_ref",
            "call y_ref",
            ("a", {}, torch.ones(3), torch.ones(5, 4), torch.full((4,), NAN), torch.ones(4).long()),
            lambda r: call(y_ref=r),
        ),
        *each(
            "u_ref",
            "call u_ref",
            ("a", {}, torch.ones(3), torch.ones(5, 2), torch.full((2,), INF), torch.ones(2).long()),
            lambda r: call(u_ref=r),
        ),
        *one("batch shapes", "batches differ", lambda: call(u_ini=randn(2, 3, 2), y_ini=randn(3, 3, 4))),
        *each("on_failure", "call on_failure", ("ignore", 3), lambda f: call(on_failure=f)),
        *each("on_failure", "set on_failure", ("ignore", None), lambda f: setting("on_failure", f)),
        *each("solver", "set solver", ("osqp", None), lambda s: setting("solver", s)),
        *each("backward", "set backward", ("half", None), lambda b: setting("backward", b)),
        *each("terminal_steps", "set terminal_steps", (-1, 1.5, 99), lambda n: setting("terminal_steps", n)),
        *each("Q", "set Q", (-1.0, "a", None, torch.eye(3)), lambda w: setting("Q", w)),
        *each("lambda_g", "set lambda_g", (-1.0, "a", None), lambda w: setting("lambda_g", w)),
        *each("u_set", "set u_set", (3, "a", dpc.Box(-torch.ones(3), torch.ones(3))), lambda s: setting("u_set", s)),
        *each("data", "set data", (None, 3, "a"), lambda d: setting("data", d)),
        *each("y_ini", "compact_form y_ini", ("a", randn(3, 7)), lambda w: small_layer().compact_form(U_INI, w)),
        *each("path", "save path", (None, 3.5, [], {}), lambda p: small_layer().save(p)),
        *each("path", "load path", (None, 3.5, [], {}), dpc.DPCLayer.load),
        *each("data", "save data", ("yes", 3, None), lambda d: small_layer().save("nowhere/at/all", data=d)),
        *each("cls", "register_set", (3, "a", None, dict, dpc.Box(-1.0, 1.0)), dpc.register_set),
    ]
