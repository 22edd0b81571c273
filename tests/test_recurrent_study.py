"""A study's cell with a recurrent policy."""

from __future__ import annotations

import pytest

pytest.importorskip("sb3_contrib")
from sb3_gcr.recurrent import RecurrentGCRPPO
from sb3_gcr.study import cells
from tests.test_study_cells import cell


@pytest.mark.parametrize("method", ["ppo", "gcr"])
def test_a_cell_with_an_lstm_is_run(method: str) -> None:
    one = cell(method, policy="MlpLstmPolicy").canonical()
    assert cells.algorithm_for(one["settings"]["policy"]) is RecurrentGCRPPO
    scalars = cells.run_cell(one)["scalars"]
    assert -200 < scalars["return_final"] <= 10.001
