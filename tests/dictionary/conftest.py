import pytest

from torchdls import _compiled, backends
from torchdls.dictionary import soup_dil, sweep_chunks


@pytest.fixture(params=["torch", "chunks", "numba"])
def sweep_by(request, monkeypatch):
    """The sweep by PyTorch, of a batch together and of surfaces one by one in small chunks; and by compiled loops."""
    if request.param == "numba":
        if not _compiled.installed():
            pytest.skip("Numba is not installed (the extra `fast`)")
        assert backends()["soup_dil_sweep"] == "numba"
        return
    monkeypatch.setattr(_compiled, "installed", lambda: False)
    assert backends()["soup_dil_sweep"] == "torch"
    if request.param == "chunks":
        monkeypatch.setattr(soup_dil, "_SHORTEST", 1)
        monkeypatch.setattr(sweep_chunks, "_CHUNK", 7)
        monkeypatch.setattr(sweep_chunks, "_FEW", 2)
