"""The Crazyflie's velocity controller and propellers: pure NumPy, no simulator.

The figures are those of the Crazyflie 2.x as identified by Luis and Le Ny (arXiv:1608.05786) and used, with this
controller structure, in gym-pybullet-drones (Panerati et al., IROS 2021). Body axes: x forward, y left, z up. The
motors, seen from above:

    3 (+x, +y)    0 (+x, -y)
    2 (-x, +y)    1 (-x, -y)
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MASS = 0.027  # [kg]
INERTIA = (1.4e-5, 1.4e-5, 2.17e-5)  # about x, y, z [kg m^2]
GRAVITY = 9.8  # [m/s^2]
THRUST_PER_RPM2 = 3.16e-10  # kf [N / RPM^2]
TORQUE_PER_RPM2 = 7.94e-12  # km [N m / RPM^2]
PROPELLERS = np.array([[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]])  # x, y [m]
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])  # the sign of each propeller's reaction torque about body z
HOVER_RPM = math.sqrt(MASS * GRAVITY / (4 * THRUST_PER_RPM2))

# rpm^2 -> (thrust along body z [N], torque about body x, y, z [N m]); a force f e_z at (x, y) has torque (y f, -x f).
WRENCH = np.stack(
    [
        THRUST_PER_RPM2 * np.ones(4),
        THRUST_PER_RPM2 * PROPELLERS[:, 1],
        -THRUST_PER_RPM2 * PROPELLERS[:, 0],
        TORQUE_PER_RPM2 * SPIN,
    ]
)

VELOCITY_GAIN = np.array([0.2, 0.2, 0.5])  # [N per m/s]
ATTITUDE_P = np.array([70000.0, 70000.0, 60000.0])  # [PWM]
ATTITUDE_I = np.array([0.0, 0.0, 500.0])  # [PWM / s]
ATTITUDE_D = np.array([20000.0, 20000.0, 12000.0])  # [PWM s / rad]
INTEGRAL_LIMIT = np.array([1.0, 1.0, 1500.0])
TORQUE_LIMIT = 3200.0  # [PWM]
PWM_MIN, PWM_MAX = 20000.0, 65535.0
RPM_PER_PWM, RPM_AT_ZERO_PWM = 0.2685, 4070.3
# Roll, pitch, yaw torque [PWM] -> motors.
MIXER = np.array([[-0.5, -0.5, -1.0], [-0.5, 0.5, 1.0], [0.5, 0.5, -1.0], [0.5, -0.5, 1.0]])


def wrench(rpm: Array) -> Array:
    """Return what the four propellers do to the body.

    Args:
        rpm: propeller speeds, shape (4,) [RPM].

    Returns:
        Thrust along body z and torques about body x, y and z, shape (4,) [N, N m, N m, N m].
    """
    return WRENCH @ (rpm * rpm)


class CrazyfliePID:
    """Turn a velocity command into propeller speeds: a P loop on velocity around a PID loop on attitude.

    The velocity error asks for a force around the hover thrust; body z is turned to that force with the heading at yaw
    0, and the thrust is the part of it along the present body z. The controller it follows has a position loop on top:
    with a pure velocity command the position target is the present position, which leaves that loop at zero, so it is
    not here. Two points differ: that one keeps whatever yaw the vehicle has, this one returns it to 0 (a plant whose
    heading wanders is not time invariant), and this one takes the difference of angles across the wrap at +-pi.

    A command more than m g / 0.5 = 0.53 m/s below the present vertical speed asks for a downward force, hence for an
    upside-down attitude. With the small torque limit, that is how large, fast commands can flip the vehicle.

    Args:
        dt: time between two calls of `rpm` [s].
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.reset()

    def reset(self, rpy: Array | None = None) -> None:
        """Forget the past.

        Args:
            rpy: present roll, pitch, yaw, shape (3,) [rad], so that the first angular rate is 0; default level.
        """
        self._rpy = np.zeros(3) if rpy is None else np.array(rpy, dtype=np.float64)
        self._integral = np.zeros(3)

    def rpm(self, command: Array, velocity: Array, rotation: Array, rpy: Array) -> Array:
        """Advance the controller by one step.

        Args:
            command: velocity asked for, world axes, shape (3,) [m/s].
            velocity: present velocity, world axes, shape (3,) [m/s].
            rotation: present attitude, body to world, shape (3, 3).
            rpy: the same attitude as roll, pitch, yaw, shape (3,) [rad].

        Returns:
            Propeller speeds, shape (4,) [RPM].
        """
        force = VELOCITY_GAIN * (command - velocity)
        force[2] += MASS * GRAVITY
        torque = self._attitude(_target_rotation(force), rotation, rpy)
        pwm: Array = _pwm_of_thrust(max(0.0, float(force @ rotation[:, 2]))) + MIXER @ torque
        return RPM_PER_PWM * _clip(pwm, PWM_MIN, PWM_MAX) + RPM_AT_ZERO_PWM

    def _attitude(self, target: Array, rotation: Array, rpy: Array) -> Array:
        """Return the torque request about x, y and z in PWM counts, shape (3,)."""
        half = target.T @ rotation
        skew = half - half.T
        # vee(Rd'R - R'Rd): twice the (small) rotation that leads from Rd to R, in body axes.
        error = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        turned = np.remainder(rpy - self._rpy + math.pi, 2 * math.pi) - math.pi  # roll and yaw wrap at +-pi
        self._rpy = rpy
        self._integral = _clip(self._integral - self.dt * error, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        torque = -ATTITUDE_P * error - ATTITUDE_D * turned / self.dt + ATTITUDE_I * self._integral
        return _clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)


def _clip(values: Array, lower: Array | float, upper: Array | float) -> Array:
    """Do what np.clip does, in a quarter of its time on arrays this short."""
    return np.asarray(np.minimum(np.maximum(values, lower), upper))


def _pwm_of_thrust(thrust: float) -> float:
    """Return the PWM at which four equal propellers give `thrust` [N]; negative where they cannot give so little."""
    return (math.sqrt(thrust / (4 * THRUST_PER_RPM2)) - RPM_AT_ZERO_PWM) / RPM_PER_PWM


def _target_rotation(force: Array) -> Array:
    """Return the attitude with z along `force` and heading 0, shape (3, 3): y = z x e_x normalised, x = y x z."""
    fx, fy, fz = force.tolist()
    size, across = math.sqrt(fx * fx + fy * fy + fz * fz), math.hypot(fy, fz)
    if across <= 1e-12 * max(size, 1.0):
        return np.eye(3)  # no force, or one along e_x, fixes no attitude: stay level
    zx, zy, zz = fx / size, fy / size, fz / size
    yy, yz = fz / across, -fy / across
    return np.array([[yy * zz - yz * zy, 0.0, zx], [yz * zx, yy, zy], [-yy * zx, yz, zz]])
