import pytest

from acsar_gym.tools.doctor.board import round_rate


@pytest.mark.parametrize(
    ("measured", "rate"),
    [(50.1, 50.0), (48.9, 50.0), (99.3, 100.0), (10.2, 10.0), (44.04, 44.0), (33.33, 33.3)],
)
def test_a_rate_close_to_a_usual_one_is_that_one(measured: float, rate: float) -> None:
    assert round_rate(measured) == rate
