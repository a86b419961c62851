"""Mutants of the attacks and of the tuning."""

from .mutant import Mutant as M

A, SUITE, BUDGETS = "attacks/test_attacks.py", "attacks/test_attack_suite.py", "attacks/test_budgets.py"
COSTS, GRADIENT, LOOP = "torch_dpc/attacks/costs.py", "torch_dpc/attacks/gradient.py", "torch_dpc/attacks/loop.py"
NORMS, ENTRIES = "torch_dpc/attacks/budgets/norms.py", "torch_dpc/attacks/budgets/entries.py"
QUERY = "attacks/test_partial_knowledge.py"

MUTANTS = [
    M(
        "psi without its half",
        COSTS,
        "return 0.5 * (solution.u - target).square()",
        "return (solution.u - target).square()",
        A,
    ),
    M(
        "the target's window starts a step late",
        COSTS,
        "self.target[min(step, len(self.target) - 1) :]",
        "self.target[min(step + 1, len(self.target) - 1) :]",
        A,
    ),
    M(
        "tracking error with its sign turned",
        COSTS,
        "return -0.5 * (error * (error @ self.Q.to(error)))",
        "return 0.5 * (error * (error @ self.Q.to(error)))",
        QUERY,
    ),
    M(
        "tracking error of the poisoned window",
        COSTS,
        "return cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=y_ref, u_ref=u_ref)",
        "return cost.given(u_ini=u_ini, y_ini=0.9 * y_ini, y_ref=y_ref, u_ref=u_ref)",
        QUERY,
    ),
    M(
        "Algorithm 1 climbs",
        LOOP,
        "vertex = budget.minimize_linear(gradient, y_ini)",
        "vertex = budget.minimize_linear(-gradient, y_ini)",
        A,
    ),
    M(
        "rounding is amplified",
        LOOP,
        "worthwhile = promised > SETTINGS.noise_floor * psi.abs()",
        "worthwhile = promised > -1.0",
        A,
    ),
    M(
        "the last answer, not the best",
        LOOP,
        "self.best_p = torch.where(chosen, self.p, self.best_p)",
        "self.best_p = self.p",
        SUITE,
    ),
    M(
        "restarts overwrite",
        LOOP,
        "better = improves(walk.best_psi, least)\n                p = torch.where(better[..., None, None], walk.best_p, p)",
        "better = improves(walk.best_psi, least)\n                p = walk.best_p",
        SUITE,
    ),
    M(
        "projected gradient climbs",
        GRADIENT,
        "return -self.step_size * walk.size * reach",
        "return self.step_size * walk.size * reach",
        SUITE,
    ),
    M(
        "another Frank-Wolfe step",
        GRADIENT,
        "return 2 / (k + 2) * (vertex - walk.p)",
        "return 1 / (k + 2) * (vertex - walk.p)",
        SUITE,
    ),
    M(
        "momentum forgets",
        GRADIENT,
        "velocity = self.momentum * walk.velocity + direction(walk.gradient)",
        "velocity = direction(walk.gradient)",
        SUITE,
    ),
    M(
        "box budget of half the size",
        ENTRIES,
        "return -self._reach(y_ini) * c.sign()",
        "return -0.5 * self._reach(y_ini) * c.sign()",
        BUDGETS,
    ),
    M(
        "ellipsoid forgets its scale",
        ENTRIES,
        "return -scale * direction(scale * c)",
        "return -scale * direction(c)",
        BUDGETS,
    ),
    M(
        "the budget's own check is blind",
        "torch_dpc/attacks/base.py",
        "if not bool((excess <= BUDGET_TOLERANCE).all()):",
        "if False:",
        SUITE,
    ),
    M("the finite-difference slope doubled", "torch_dpc/attacks/query.py", "/ (2 * self.probe)", "/ self.probe", QUERY),
]
