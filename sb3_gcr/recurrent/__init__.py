"""GCR-PPO for policies with memory: ``RecurrentGCRPPO`` on sb3-contrib's ``RecurrentPPO``.

:raises ImportError: if sb3-contrib is not installed
"""

try:
    import sb3_contrib  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"sb3_gcr.recurrent needs sb3-contrib: pip install 'sb3_gcr[recurrent]' ({error})"
    ) from error

from sb3_gcr.recurrent.buffers import (
    VectorRecurrentDictRolloutBuffer,
    VectorRecurrentRolloutBuffer,
)
from sb3_gcr.recurrent.policies import CnnLstmPolicy, MlpLstmPolicy, MultiInputLstmPolicy
from sb3_gcr.recurrent.recurrent_gcrppo import RecurrentGCRPPO

__all__ = [
    "CnnLstmPolicy",
    "MlpLstmPolicy",
    "MultiInputLstmPolicy",
    "RecurrentGCRPPO",
    "VectorRecurrentDictRolloutBuffer",
    "VectorRecurrentRolloutBuffer",
]
