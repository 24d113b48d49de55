"""What an action means to a bank: values beyond the box count as its edge."""

import numpy as np
import pytest

from filtergym.envs.contract.controls import bank_probabilities

LOG_PREDICTED = np.log([[0.2, 0.5], [0.8, 0.5]])
LOG_LIKELIHOOD = np.array([[-1.0, -2.0], [-3.0, 0.5]])


@pytest.mark.parametrize(("control", "low"), [("evidence", -1.0), ("weights", 0.0)])
def test_values_beyond_the_box_count_as_its_edge(control, low):
    def probabilities(action):
        return bank_probabilities(control, np.array(action), LOG_PREDICTED, LOG_LIKELIHOOD, 4.0, np)

    beyond, edge = [[5.0, 0.3], [-7.0, 1.5]], [[1.0, 0.3], [low, 1.0]]
    np.testing.assert_array_equal(probabilities(beyond), probabilities(edge))


def test_weights_are_normalised_and_zero_is_uniform():
    found = bank_probabilities(
        "weights", np.array([[0.2, 0.0], [0.6, 0.0]]), LOG_PREDICTED, LOG_LIKELIHOOD, 4.0, np
    )
    np.testing.assert_allclose(found, [[0.25, 0.5], [0.75, 0.5]], rtol=1e-14)


def test_evidence_is_added_to_the_logarithm():
    action = np.array([[0.5, -1.0], [0.0, 0.25]])
    weighed = np.exp(LOG_PREDICTED + LOG_LIKELIHOOD + 4.0 * action)
    found = bank_probabilities("evidence", action, LOG_PREDICTED, LOG_LIKELIHOOD, 4.0, np)
    np.testing.assert_allclose(found, weighed / weighed.sum(axis=0), rtol=1e-14)
