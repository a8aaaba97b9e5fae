"""The examples in the docstrings."""

import doctest

import mjx_cmaes
import mjx_cmaes.driver
import mjx_cmaes.ranking
import pytest


@pytest.mark.parametrize("module", [mjx_cmaes, mjx_cmaes.driver, mjx_cmaes.ranking])
def test_examples(module):
    names = vars(mjx_cmaes) | vars(module)
    result = doctest.testmod(module, extraglobs=names)
    assert result.attempted > 0
    assert result.failed == 0
