"""The learning rate that follows the KL divergence."""

from __future__ import annotations

#: The paper's bounds of the learning rate, and its step.
MIN_LEARNING_RATE, MAX_LEARNING_RATE = 1e-5, 1e-2
FACTOR = 1.5


def adapt_learning_rate(learning_rate: float, kl: float, desired_kl: float) -> float:
    """Next learning rate: ÷ 1.5 where KL > 2 desired_kl, × 1.5 where KL < desired_kl / 2, within
    [1e-5, 1e-2].

    :param learning_rate: current rate
    :param kl: KL(old policy ‖ current policy) of the minibatch
    :param desired_kl: target, > 0
    :return: the rate of the next step
    """
    if kl > 2 * desired_kl:
        return max(MIN_LEARNING_RATE, learning_rate / FACTOR)
    if kl < desired_kl / 2:
        return min(MAX_LEARNING_RATE, learning_rate * FACTOR)
    return learning_rate
