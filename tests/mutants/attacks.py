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
        A + " -k half_the_squared",
    ),
    M(
        "the target's window starts a step late",
        COSTS,
        "self.target[min(step, len(self.target) - 1) :]",
        "self.target[min(step + 1, len(self.target) - 1) :]",
        A + " -k windowed",
    ),
    M(
        "tracking error with its sign turned",
        COSTS,
        "return -0.5 * (error * (error @ self.Q.to(error)))",
        "return 0.5 * (error * (error @ self.Q.to(error)))",
        QUERY + " -k tracking_error",
    ),
    M(
        "tracking error of the poisoned window",
        COSTS,
        "return cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=y_ref, u_ref=u_ref)",
        "return cost.given(u_ini=u_ini, y_ini=0.9 * y_ini, y_ref=y_ref, u_ref=u_ref)",
        QUERY + " -k bind or tracking_error",
    ),
    M(
        "Algorithm 1 climbs",
        LOOP,
        "vertex = budget.minimize_linear(gradient, y_ini)",
        "vertex = budget.minimize_linear(-gradient, y_ini)",
        A + " -k by_hand",
    ),
    M(
        "rounding is amplified",
        LOOP,
        "worthwhile = promised > SETTINGS.noise_floor * psi.abs()",
        "worthwhile = promised > -1.0",
        A + " -k rounding",
    ),
    M(
        "the last answer, not the best",
        LOOP,
        "self.best_p = torch.where(chosen, self.p, self.best_p)",
        "self.best_p = self.p",
        SUITE + " -k never_worse or restarts",
    ),
    M(
        "restarts overwrite",
        LOOP,
        "better = improves(walk.best_psi, least)\n                p = torch.where(better[..., None, None], walk.best_p, p)",
        "better = improves(walk.best_psi, least)\n                p = walk.best_p",
        SUITE + " -k restarts",
    ),
    M(
        "projected gradient climbs",
        GRADIENT,
        "return -self.step_size * walk.size * reach",
        "return self.step_size * walk.size * reach",
        SUITE + " -k trust_region or never_worse",
    ),
    M(
        "another Frank-Wolfe step",
        GRADIENT,
        "return 2 / (k + 2) * (vertex - walk.p)",
        "return 1 / (k + 2) * (vertex - walk.p)",
        SUITE + " -k textbook or trust_region",
    ),
    M(
        "momentum forgets",
        GRADIENT,
        "velocity = self.momentum * walk.velocity + direction(walk.gradient)",
        "velocity = direction(walk.gradient)",
        SUITE + " -k textbook or trust_region",
    ),
    M(
        "box budget of half the size",
        ENTRIES,
        "return -self._reach(y_ini) * c.sign()",
        "return -0.5 * self._reach(y_ini) * c.sign()",
        BUDGETS + " -k no_admissible",
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
        SUITE + " -k leaves_its_budget",
    ),
    M(
        "the finite-difference slope doubled",
        "torch_dpc/attacks/query.py",
        "/ (2 * self.probe)",
        "/ self.probe",
        QUERY + " -k slope_by_queries",
    ),
]
