"""A PyBullet server with one vehicle over flat ground: the only module that imports pybullet."""

import ctypes
import importlib
import importlib.resources
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DAMPING = 0.04  # share of the linear and angular velocity lost per second: Bullet's default, written down


class State(NamedTuple):
    """Where the vehicle is and how it moves, in world axes."""

    position: Array  # (3,) [m]
    velocity: Array  # (3,) [m/s]
    rotation: Array  # body to world, (3, 3)
    rpy: Array  # roll, pitch, yaw, (3,) [rad]


class BulletWorld:
    """Own one PyBullet server, so that several worlds live side by side in one process.

    Every call that has a state behind it names its server: pybullet's own default is whichever connected first.

    Args:
        urdf: file name in `torch_dpc/systems/data`.
        gravity: downwards [m/s^2].
        time_step: [s].
        gui: open PyBullet's window.
    """

    def __init__(self, urdf: str, gravity: float, time_step: float, gui: bool) -> None:
        self._urdf = importlib.resources.files("torch_dpc.systems") / "data" / urdf
        self._gravity, self._time_step = gravity, time_step
        self._bullet = _import_pybullet()
        self._server = _connect(self._bullet, gui)
        # Runs once at most: on close(), when the world goes, or at interpreter exit while modules are still there.
        self._finalizer = weakref.finalize(self, _disconnect, self._bullet, self._server)

    @property
    def closed(self) -> bool:
        """Whether the server was given back."""
        return not self._finalizer.alive

    def close(self) -> None:
        """Give the server back; further calls do nothing."""
        self._finalizer()

    def build(self, position: Array, rpy: Array) -> None:
        """Empty the world and put ground and vehicle, at rest, into it.

        Rebuilding, rather than moving the vehicle back, also drops Bullet's contact caches: the same inputs then give
        the same bytes, whatever happened before.
        """
        bullet, server = self._bullet, self._server
        bullet.resetSimulation(physicsClientId=server)
        bullet.setGravity(0.0, 0.0, -self._gravity, physicsClientId=server)
        bullet.setTimeStep(self._time_step, physicsClientId=server)
        # Without a visual shape of its own a plane is drawn as a chequerboard.
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=[0.0, 0.0, 1.0], physicsClientId=server)
        self._ground = bullet.createMultiBody(0.0, plane, physicsClientId=server)
        with importlib.resources.as_file(self._urdf) as path:
            self._body = bullet.loadURDF(
                str(path),
                position.tolist(),
                bullet.getQuaternionFromEuler(rpy.tolist()),
                flags=bullet.URDF_USE_INERTIA_FROM_FILE,  # else Bullet derives it from the collision shape
                physicsClientId=server,
            )
        bullet.changeDynamics(self._body, -1, linearDamping=DAMPING, angularDamping=DAMPING, physicsClientId=server)

    def state(self) -> State:
        """Return the vehicle's present state."""
        bullet = self._bullet
        position, quaternion = bullet.getBasePositionAndOrientation(self._body, physicsClientId=self._server)
        velocity, _ = bullet.getBaseVelocity(self._body, physicsClientId=self._server)
        rotation = np.array(bullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
        rpy = np.array(bullet.getEulerFromQuaternion(quaternion))
        return State(np.array(position), np.array(velocity), rotation, rpy)

    def inertia(self) -> tuple[float, tuple[float, float, float]]:
        """Return what Bullet integrates: the vehicle's mass [kg] and its inertia about body x, y, z [kg m^2]."""
        info = self._bullet.getDynamicsInfo(self._body, -1, physicsClientId=self._server)
        return info[0], info[2]

    def advance(self, wrench: Array) -> None:
        """Do one physics step under a thrust along body z and torques about body x, y, z, shape (4,) [N, N m]."""
        bullet, server = self._bullet, self._server
        thrust, *torque = wrench.tolist()
        frame = bullet.LINK_FRAME
        bullet.applyExternalForce(self._body, -1, [0.0, 0.0, thrust], [0.0, 0.0, 0.0], frame, physicsClientId=server)
        bullet.applyExternalTorque(self._body, -1, torque, frame, physicsClientId=server)
        bullet.stepSimulation(physicsClientId=server)

    def on_ground(self) -> bool:
        """Return whether the vehicle touches the ground; Bullet lists points that are merely near (0.5 mm), too."""
        contacts = self._bullet.getContactPoints(self._body, self._ground, physicsClientId=self._server)
        return any(contact[8] <= 0.0 for contact in contacts)

    def picture(
        self, width: int, height: int, target: Array, distance: float, yaw: float, pitch: float, fov: float
    ) -> NDArray[np.uint8]:
        """Return what a camera sees, rendered in software, shape (height, width, 3); angles in degrees."""
        bullet = self._bullet
        view = bullet.computeViewMatrixFromYawPitchRoll(target.tolist(), distance, yaw, pitch, 0.0, 2)
        lens = bullet.computeProjectionMatrixFOV(fov, width / height, 0.01, 100.0)
        _, _, rgba, _, _ = bullet.getCameraImage(
            width,
            height,
            view,
            lens,
            lightDirection=[1.0, -1.5, 4.0],
            lightDistance=10.0,
            shadow=1,
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._server,
        )
        return np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3].copy()


def _import_pybullet() -> ModuleType:
    try:
        with _silent_c_output():
            return importlib.import_module("pybullet")
    except ImportError as error:
        hint = "pip install 'torch_dpc[quadrotor]'."
        if sys.version_info > (3, 12):
            version = f"{sys.version_info.major}.{sys.version_info.minor}"
            hint = (
                f"it has wheels up to Python 3.11, and this is Python {version}. systems.TorchQuadrotor is the same "
                "vehicle and needs no PyBullet."
            )
        raise ImportError(f"systems.Quadrotor needs PyBullet: {hint}") from error


@contextmanager
def _silent_c_output() -> Iterator[None]:
    """Keep from the terminal the build time that PyBullet's C code prints when it is first imported."""
    if "pybullet" in sys.modules:
        yield
        return
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # C keeps what it prints into a pipe until then
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _connect(bullet: ModuleType, gui: bool) -> int:
    # Without an X server pybullet ends the whole process, so look first.
    if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise RuntimeError("`gui=True` needs a display, and DISPLAY is not set; `render` works without one.")
    server: Any = bullet.connect(bullet.GUI if gui else bullet.DIRECT)
    if server < 0:
        raise RuntimeError("PyBullet gave no physics server; it opens at most one window per process.")
    return int(server)


def _disconnect(bullet: ModuleType, server: int) -> None:
    if bullet.isConnected(physicsClientId=server):
        bullet.disconnect(physicsClientId=server)
