"""The check of the backend, and jax issue 39103 as it stands in the jax that is installed."""

import pytest

import jsecon.backend as backend

pytestmark = pytest.mark.as_shipped


def test_our_forms_are_right_here_and_the_report_says_what_it_measured():
    report = backend.check_backend()
    assert report.platform == "cpu"
    assert 0 < report.cosine_error < 1e-5
    assert report.has_jax_39103 == (tuple(map(int, report.jax_version.split(".")[:2])) < (0, 11)), backend.REMEDY
    if report.has_jax_39103:
        with pytest.raises(RuntimeError, match=r"39103.*XLA_FLAGS"):
            backend.check_backend(strict=True)
    else:
        assert backend.check_backend(strict=True).matvec_error < 1e-3


def test_wrong_cosines_raise(monkeypatch):
    monkeypatch.setattr(backend, "cosine_matrix", lambda f, t: f @ t.T)
    with pytest.raises(RuntimeError, match="cosines are off"):
        backend.check_backend()
