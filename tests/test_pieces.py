"""Work in pieces: the same results as in one go, and the caller's threads given back."""

from __future__ import annotations

import pytest
import torch

from grr_torch.pieces import in_pieces, piece

_PIECE = piece(torch.device("cpu"))


@pytest.mark.parametrize("count", [0, 1, _PIECE - 1, _PIECE, _PIECE + 1, 3 * _PIECE])
def test_pieces_are_joined_in_order(count):
    a, b = torch.randn(3, count), torch.randn(2, 2, count)
    total, positive = in_pieces(lambda a, b: (a.sum(0) + b[0, 1], a > 0.0), a, b)
    assert torch.equal(total, a.sum(0) + b[0, 1])
    assert torch.equal(positive, a > 0.0)


def test_gradients_pass_through_pieces():
    a = torch.randn(2, _PIECE + 5, dtype=torch.float64, requires_grad=True)
    in_pieces(lambda a: (a.square().sum(0),), a)[0].sum().backward()
    torch.testing.assert_close(a.grad, 2.0 * a.detach())


def test_the_caller_s_threads_are_given_back_even_after_an_error():
    before = torch.get_num_threads()
    seen = []

    def failing(a):
        seen.append(torch.get_num_threads())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_pieces(failing, torch.zeros(3))
    assert seen == [1]
    assert torch.get_num_threads() == before
