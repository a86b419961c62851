"""Mutants of the controller, the closed loop and the plants."""

from .mutant import Mutant as M

CTRL, LOOP = "torch_dpc/control/controller.py", "torch_dpc/control/loop.py"
TESTS, BATCHED = "control/test_controller.py", "control/test_batched_runs.py"
STATE, SOFT = "systems/test_state_space.py", "control/test_soften.py"

MUTANTS = [
    M(
        "replanning a step late",
        CTRL,
        "return self.state.due == 0",
        "return self.state.due == -1",
        TESTS + " -k open_loop or knows",
    ),
    M(
        "the plan starts at its second input",
        CTRL,
        "return state.inputs[..., state.age, :]",
        "return state.inputs[..., state.age + 1, :]",
        TESTS + " -k open_loop",
    ),
    M(
        "the first input is repeated",
        CTRL,
        "return state.inputs[..., state.age, :]",
        "return state.inputs[..., 0, :]",
        TESTS + " -k open_loop",
    ),
    M(
        "hold repeats the plan from its start",
        CTRL,
        "return torch.cat([inputs[..., age:, :], held], dim=-2)",
        "return inputs",
        TESTS + " -k hold_goes",
    ),
    M(
        "the attack reaches the plant's window",
        LOOP,
        "self.past.append(u, self.y)\n        self.y = self.port.step(u)\n        return u",
        "self.past.append(u, self.y + self.p[..., -1, :])\n        self.y = self.port.step(u)\n        return u",
        TESTS + " -k attack_is_on or sees_the_truth or reaches_the_plant",
    ),
    M(
        "the attack is added to the plant's input",
        LOOP,
        "self.y = self.port.step(u)\n        return u",
        "self.y = self.port.step(u + self.p[..., -1, : u.shape[-1]])\n        return u",
        TESTS + " -k attack_is_on or sees_the_truth or reaches_the_plant",
    ),
    M(
        "the attack is subtracted",
        LOOP,
        "u = self.controller.step(u_ini, y_ini + self.p, **refs, alarm=self.alarm)",
        "u = self.controller.step(u_ini, y_ini - self.p, **refs, alarm=self.alarm)",
        TESTS + " -k attack_is_on or sees_the_truth or reaches_the_plant",
    ),
    M(
        "the reference lags a step",
        LOOP,
        "ahead = slice(k, k + self.data.horizon)",
        "ahead = slice(max(k - 1, 0), max(k - 1, 0) + self.data.horizon)",
        TESTS + " -k held_beyond or sees_the_truth or settles",
    ),
    M(
        "the attack's step counts from one",
        LOOP,
        "generator=self.generator, step=k)",
        "generator=self.generator, step=k + 1)",
        TESTS + " -k sees_the_truth",
    ),
    M(
        "softening at twice the price",
        "torch_dpc/control/soften.py",
        "(price <= weight)",
        "(price <= 2 * weight)",
        SOFT + " -k price",
    ),
    M(
        "softening widens the inputs",
        "torch_dpc/control/soften.py",
        "return slice(layer.sizes.u, layer.sizes.u + layer.sizes.y)",
        "return slice(0, layer.sizes.u + layer.sizes.y)",
        SOFT + " -k price or shrink",
    ),
    M(
        "the masses by Euler's method",
        "torch_dpc/systems/state_space.py",
        "whole = torch.linalg.matrix_exp(block * dt)",
        "whole = torch.eye(n + m, dtype=A.dtype) + block * dt",
        STATE + " -k matrix_exponential",
    ),
    M(
        "the masses' springs pull the wrong way",
        "torch_dpc/systems/masses.py",
        "-stiffness / mass, -damping / mass * eye",
        "stiffness / mass, -damping / mass * eye",
        STATE + " -k matrix_exponential",
    ),
    M(
        "a recording shifted by a step",
        "torch_dpc/systems/plant.py",
        "        y = port.step(u)\n    return torch.stack(inputs",
        "        y = port.step(u)\n        outputs[-1] = y\n    return torch.stack(inputs",
        "systems/test_plant.py -k recorded",
    ),
]
