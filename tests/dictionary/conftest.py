import pytest

from torchdls import backends
from torchdls.dictionary import sweep_fused


@pytest.fixture(params=["torch", "numba"])
def sweep_by(request, monkeypatch):
    """The sweep by PyTorch alone, and by the compiled loops."""
    if request.param == "torch":
        monkeypatch.setattr(sweep_fused, "installed", lambda: False)
    elif not sweep_fused.installed():
        pytest.skip("Numba is not installed (the extra `fast`)")
    assert backends() == {"soup_dil_sweep": request.param}
    return request.param
