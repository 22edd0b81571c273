"""The 26 terms of LocoManip, with the weights of the paper's task for the Digit.

Each is a weight per second times 0.02 s times a value.
"""

from __future__ import annotations

import numpy as np

from sb3_gcr.envs.task import Array

#: Duration of a control step [s].
DT = 0.02
#: Width of the tracking terms [m²/s², rad²/s²].
VARIANCE = 0.25
#: Distance at which the fine-grained terms pay a quarter of what they pay at the goal [m].
FINE = 0.05
#: Longest time of a foot in the air or on the ground that pays [s].
LONGEST_STEP = 0.8
#: Commanded speeds below which a step pays nothing, and the legs have to keep still [m/s].
STEPPING_SPEED, STANDING_SPEED = 0.1, 0.06
#: Part of a joint's range that is free of charge.
SOFT_LIMIT = 0.9

#: Names and levels in the order of the terms.
LEVELS = {
    "termination_penalty": "task",
    "track_lin_vel_xy_exp": "task",
    "track_ang_vel_z_exp": "task",
    "feet_air_time": "regulariser",
    "feet_slide": "regulariser",
    "dof_torques_l2": "regulariser",
    "dof_acc_l2": "regulariser",
    "action_rate_l2": "regulariser",
    "flat_orientation_l2": "regulariser",
    "stand_still": "regulariser",
    "lin_vel_z_l2": "regulariser",
    "ang_vel_xy_l2": "regulariser",
    "no_jumps": "regulariser",
    "dof_pos_limits": "regulariser",
    "joint_deviation_hip_roll": "regulariser",
    "joint_deviation_hip_yaw": "regulariser",
    "joint_deviation_knee": "regulariser",
    "joint_deviation_feet": "regulariser",
    "undesired_contacts": "regulariser",
    "joint_vel_hip_yaw": "regulariser",
    "left_ee_pos_tracking": "task",
    "left_ee_pos_tracking_fine_grained": "task",
    "left_end_effector_orientation_tracking": "task",
    "right_ee_pos_tracking": "task",
    "right_ee_pos_tracking_fine_grained": "task",
    "right_end_effector_orientation_tracking": "task",
}


def termination_penalty(has_fallen: Array) -> Array:
    """-2, once.

    :param has_fallen: shape (N,)
    """
    return -100 * DT * has_fallen


def track_lin_vel_xy_exp(command: Array, velocity: Array) -> Array:
    """0.02 exp(-‖v* - v‖² / 0.25).

    :param command: v* forward and to the left [m/s], and the turn, shape (N, 3)
    :param velocity: v, shape (N, 2)
    """
    return DT * np.exp(-np.square(command[:, :2] - velocity).sum(1) / VARIANCE)


def track_ang_vel_z_exp(command: Array, turn: Array) -> Array:
    """0.02 exp(-(ω* - ω)² / 0.25).

    :param command: velocity, and ω* about the vertical [rad/s], shape (N, 3)
    :param turn: ω, shape (N,)
    """
    return DT * np.exp(-np.square(command[:, 2] - turn) / VARIANCE)


def feet_air_time(command: Array, air_time: Array, contact_time: Array) -> Array:
    """0.005/s times the time since the last foot has left the ground or touched it, at most 0.8 s,
    while one foot is on the ground and the robot is to walk.

    :param command: shape (N, 3)
    :param air_time: of each foot [s], 0 on the ground, shape (N, 2)
    :param contact_time: of each foot [s], 0 in the air, shape (N, 2)
    """
    has_one = (contact_time > 0).sum(1) == 1
    shorter = np.maximum(air_time, contact_time).min(1)
    pays = has_one & (_speed(command) > STEPPING_SPEED)
    return 0.25 * DT * np.minimum(shorter, LONGEST_STEP) * pays


def feet_slide(velocities: Array, is_grounded: Array) -> Array:
    """-0.005 s/m times the speed of each foot on the ground.

    :param velocities: of the feet along the ground [m/s], shape (N, 2, 2)
    :param is_grounded: shape (N, 2)
    """
    return -0.25 * DT * (np.linalg.norm(velocities, axis=2) * is_grounded).sum(1)


def dof_torques_l2(torques: Array) -> Array:
    """-2e-8 Σ τ².

    :param torques: of all joints [N m], shape (N, 22)
    """
    return -1e-6 * DT * np.square(torques).sum(1)


def dof_acc_l2(accelerations: Array) -> Array:
    """-4e-9 Σ q̈².

    :param accelerations: of all joints [rad/s²], shape (N, 22)
    """
    return -2e-7 * DT * np.square(accelerations).sum(1)


def action_rate_l2(actions: Array, actions_before: Array) -> Array:
    """-1.6e-4 Σ (a_t - a_{t-1})².

    :param actions: shape (N, 22)
    :param actions_before: of the step before, shape (N, 22)
    """
    return -0.008 * DT * np.square(actions - actions_before).sum(1)


def flat_orientation_l2(gravity: Array) -> Array:
    """-0.21 (g_x² + g_y²), 0.21 sin² of the tilt.

    :param gravity: its direction g in the pelvis' frame, shape (N, 3)
    """
    return -10.5 * DT * np.square(gravity[:, :2]).sum(1)


def stand_still(command: Array, deviations: Array) -> Array:
    """-0.008/rad times the legs' distance from the default pose, while the robot is to stand.

    :param command: shape (N, 3)
    :param deviations: abs(q - q_default) [rad], shape (N, 12)
    """
    return -0.4 * DT * deviations.sum(1) * (_speed(command) < STANDING_SPEED)


def lin_vel_z_l2(velocity: Array) -> Array:
    """-0.04 s²/m² v_z².

    :param velocity: v_z, of the pelvis along its own z axis [m/s], shape (N,)
    """
    return -2.0 * DT * np.square(velocity)


def ang_vel_xy_l2(velocity: Array) -> Array:
    """-0.002 s²/rad² (ω_x² + ω_y²).

    :param velocity: angular, of the pelvis about its own axes x and y [rad/s], shape (N, 2)
    """
    return -0.1 * DT * np.square(velocity).sum(1)


def no_jumps(contact_time: Array) -> Array:
    """-0.01 while no foot is on the ground.

    :param contact_time: of each foot, 0 in the air, shape (N, 2)
    """
    return -0.5 * DT * (contact_time == 0).all(1)


def dof_pos_limits(excess: Array) -> Array:
    """-0.02/rad times how far knees and ankles are beyond 90 % of their range.

    :param excess: [rad], shape (N, 6)
    """
    return -1.0 * DT * excess.sum(1)


def joint_deviation_hip_roll(deviations: Array) -> Array:
    """-0.002/rad Σ abs(q - q_default).

    :param deviations: of the hips' roll [rad], shape (N, 2)
    """
    return -0.1 * DT * deviations.sum(1)


def joint_deviation_hip_yaw(deviations: Array) -> Array:
    """-0.004/rad Σ abs(q - q_default).

    :param deviations: of the hips' yaw [rad], shape (N, 2)
    """
    return -0.2 * DT * deviations.sum(1)


def joint_deviation_knee(deviations: Array) -> Array:
    """-0.004/rad Σ abs(q - q_default).

    :param deviations: of the knees [rad], shape (N, 2)
    """
    return -0.2 * DT * deviations.sum(1)


def joint_deviation_feet(deviations: Array) -> Array:
    """-0.002/rad Σ abs(q - q_default).

    :param deviations: of the ankles' pitch and roll [rad], shape (N, 4)
    """
    return -0.1 * DT * deviations.sum(1)


def undesired_contacts(is_touching: Array) -> Array:
    """-0.002 for each shin on the ground.

    :param is_touching: shape (N, 2)
    """
    return -0.1 * DT * is_touching.sum(1)


def joint_vel_hip_yaw(velocities: Array) -> Array:
    """-2e-5 s²/rad² Σ q̇².

    :param velocities: of the hips' yaw [rad/s], shape (N, 2)
    """
    return -0.001 * DT * np.square(velocities).sum(1)


def ee_pos_tracking(distance: Array) -> Array:
    """-0.04/m d.

    :param distance: d, from a palm to its goal [m], shape (N,)
    """
    return -2.0 * DT * distance


def ee_pos_tracking_fine_grained(distance: Array) -> Array:
    """0.04 (1 - tanh(d / 0.05 m)).

    :param distance: d, from a palm to its goal [m], shape (N,)
    """
    return 2.0 * DT * (1 - np.tanh(distance / FINE))


def end_effector_orientation_tracking(angle: Array) -> Array:
    """-0.004/rad φ.

    :param angle: φ, of the turn from a hand to its goal [rad], shape (N,)
    """
    return -0.2 * DT * angle


def _speed(command: Array) -> Array:
    """Commanded speed along the ground [m/s], shape (N,)."""
    return np.linalg.norm(command[:, :2], axis=1)
