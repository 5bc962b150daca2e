"""Hillshades against closed forms; figures and pages by what they contain."""

import io
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchdls import plot


def surface(h=40, w=60):
    y, x = torch.meshgrid(torch.arange(h).double(), torch.arange(w).double(), indexing="ij")
    return (8 * torch.sin(x / 9) * torch.cos(y / 7))[None, None]


def noisy(seed=0):
    truth = surface()
    return truth + torch.randn(truth.shape, dtype=truth.dtype, generator=torch.Generator().manual_seed(seed))


# --- hillshade -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth, altitude", [(315, 45), (90, 30), (180, 60), (10, 90)])
def test_hillshade_of_a_plane_is_the_cosine_to_the_lamp(azimuth, altitude):
    y, x = torch.meshgrid(torch.arange(5).double(), torch.arange(6).double(), indexing="ij")
    zx, zy = 0.3, -0.2  # right, down
    z = zx * 0.5 * x + zy * 2.0 * y
    shade = plot.hillshade(z, (0.5, 2.0), azimuth, altitude)
    a, e = np.radians([azimuth, altitude])
    lamp = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
    normal = np.array([-zx, zy, 1]) / np.linalg.norm([-zx, zy, 1])
    np.testing.assert_allclose(shade, max(0.0, normal @ lamp), atol=1e-12)


def test_the_lamp_stands_at_the_upper_left():
    x = torch.arange(9.0).expand(9, 9)
    rises_left, rises_right = plot.hillshade(-x), plot.hillshade(x)
    assert rises_right.mean() > rises_left.mean()  # a slope that rises to the right faces left, into the light
    assert plot.hillshade(x.T).mean() > plot.hillshade(-x.T).mean()


def test_hillshade_keeps_the_outside_blank():
    z = surface()[0, 0]
    z[:, :10] = torch.nan
    assert plot.hillshade(z)[:, :10].isnan().all()
    assert plot.hillshade(z)[:, 12:].isfinite().all()


# --- the figure ----------------------------------------------------------------------------------------------------


def texts(figure: Figure):
    return [t.get_text() for t in figure.findobj(Text)]


@pytest.mark.parametrize("with_slopes", [False, True])
def test_comparison_shows_every_surface_with_its_measures(with_slopes):
    truth, measured = surface(), torch.zeros(1, 2, 40, 60, dtype=torch.float64)
    figure = plot.compare_heights(
        truth,
        {"Least squares": noisy(0), "DLS": noisy(1) + 100},
        title="Test",
        data_range=5.0,
        measured=measured if with_slopes else None,
    )
    assert isinstance(figure, Figure)
    found = texts(figure)
    for name in ("Test", "Ground truth", "Least squares", "DLS", "Error of DLS", "height error (px)"):
        assert name in found
    assert ("The measured slopes, as normals" in found) == with_slopes
    assert ("Section along row 20" in found) != with_slopes
    for seed in (0, 1):
        error = (noisy(seed) - truth).numpy()
        assert any(f"RMSE {error.std():#.3g} px" in text for text in found)  # modulo the constant
    images = [axis.images[0] for axis in figure.axes if axis.images and axis.images[0].get_array().ndim == 2]
    assert len({image.get_clim() for image in images}) == 1  # one scale for all errors
    figure.savefig(buffer := io.BytesIO(), format="png")
    assert buffer.getvalue().startswith(b"\x89PNG")


def test_comparison_without_a_truth_and_with_a_mask():
    mask = torch.ones(1, 1, 40, 60, dtype=torch.bool)
    mask[..., :20] = False
    height = noisy()
    height[..., :20] = torch.nan
    figure = plot.compare_heights(None, {"Surface": height}, mask=mask, unit="mm")
    assert not any(text.startswith("Error") for text in texts(figure))
    relief = figure.axes[0].images[0].get_array()
    assert (relief[:, :20, 3] == 0).all()
    assert (relief[:, 22:, 3] == 1).all()
    figure.savefig(io.BytesIO(), format="png")


def test_a_constant_surface_is_drawn():
    flat = torch.full((1, 1, 12, 12), 3.0)
    plot.compare_heights(flat, {"Flat": flat}, data_range=1.0).savefig(io.BytesIO(), format="png")
    assert len(plot.surface_page({"Flat": flat}).data) == 1


def test_nothing_global_changes():
    code = (
        "import sys, torch; from torchdls.plot import compare_heights; z = torch.rand(1, 1, 9, 9);"
        "compare_heights(None, {'z': z}); sys.exit('matplotlib.pyplot' in sys.modules or 'plotly' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- the preview ---------------------------------------------------------------------------------------------------


def shown_maps(figure):
    """Title on the left -> the array of each map with a colour bar, and the label of the bar."""
    maps = {a.get_title(loc="left"): a.images[0] for a in figure.axes if a.images}
    return {
        name: (image.get_array(), image.colorbar and image.colorbar.ax.get_ylabel()) for name, image in maps.items()
    }


def test_preview_shows_each_map_that_is_given_with_its_unit():
    truth, height = surface(), noisy(0) + 7
    mask = torch.ones(1, 1, 40, 60, dtype=torch.bool)
    mask[..., :20] = False
    gradient = torch.zeros(1, 2, 40, 60, dtype=torch.float64)
    trust, jump = torch.ones(1, 1, 40, 60), torch.zeros(1, 2, 40, 60)
    trust[..., 10, 30], jump[:, 1, 20, 40] = 0.25, 0.7
    extra = {"gradient": gradient, "truth": truth, "trust": 4 * trust, "jump": jump}
    figure = plot.surface_preview(height, mask=mask, title="Test", unit="mm", **extra)
    maps = shown_maps(figure)
    assert [*maps][:4] == ["Relief", "Height", "Measured normals", "Residual"]
    units = {name: unit for name, (_, unit) in maps.items() if unit}
    assert units["Height"] == "mm"
    assert (units["Residual"], units["Trust in the slopes"], units["Jumps"]) == (
        "slope",
        "of the largest",
        "probability",
    )
    assert maps["Trust in the slopes"][0][10, 30] == 0.25
    assert maps["Jumps"][0][20, 40] == pytest.approx(0.7)
    (error,) = [array for name, (array, _) in maps.items() if name.startswith("Error, RMSE")]
    found = (height - truth)[0, 0, :, 20:].numpy()
    np.testing.assert_allclose(error[:, 20:], found - found.mean(), atol=1e-12)
    assert all(np.ma.getmaskarray(maps[name][0])[:, :20].all() for name in units)  # blank outside the mask
    assert set(shown_maps(plot.surface_preview(height))) == {"Relief", "Height"}
    plot.surface_preview(height, gradient=gradient, mask=trust < 1)  # a lone pixel has no edge
    figure.savefig(io.BytesIO(), format="png")


def test_the_residual_is_that_of_the_edges_of_a_pixel():
    z, gradient = noisy(1), torch.randn(1, 2, 40, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found = shown_maps(plot.surface_preview(z, gradient=gradient, pixel_size=(2.0, 0.5)))["Residual"][0]
    h, (gx, gy) = z[0, 0].numpy(), gradient[0].numpy()
    for i, j in [(0, 0), (7, 11), (39, 59), (20, 0)]:
        steps = [(i, j - 1, i, j), (i, j, i, j + 1)], [(i - 1, j, i, j), (i, j, i + 1, j)]
        misfits = [
            (h[c, d] - h[a, b]) / size - (g[a, b] + g[c, d]) / 2
            for edges, g, size in zip(steps, (gx, gy), (2.0, 0.5), strict=True)
            for a, b, c, d in edges
            if min(a, b) >= 0 and c < 40 and d < 60
        ]
        assert found[i, j] == pytest.approx(np.sqrt(np.mean(np.square(misfits))))


def test_the_relief_of_a_depth_is_turned_towards_the_viewer():
    """Depth falls where the surface rises; an exact gradient of its logarithm leaves no residual."""
    log_depth = -surface() / 100
    gradient = torch.stack(torch.gradient(log_depth[0, 0], dim=(1, 0)))[None]
    maps = shown_maps(plot.surface_preview(log_depth.exp(), gradient=gradient, quantity="depth"))
    rise = shown_maps(plot.surface_preview(surface()))
    assert {"Relief", "Depth", "Residual"} <= set(maps)
    np.testing.assert_allclose(maps["Relief"][0], rise["Relief"][0], atol=1e-6)
    assert maps["Residual"][0][1:-1, 1:-1].max() < 1e-3


# --- the page ------------------------------------------------------------------------------------------------------


def test_page_has_a_button_for_each_surface_and_one_visible():
    page = plot.surface_page({"Least squares": noisy(0), "DLS": noisy(1)}, notes={"DLS": "RMSE 1"}, title="Test")
    assert [trace.visible for trace in page.data] == [True, False]
    buttons = page.layout.updatemenus[0].buttons
    assert [button.label for button in buttons] == ["Least squares", "DLS"]
    assert buttons[1].args[0]["visible"] == [False, True]
    assert "RMSE 1" in buttons[1].args[1]["annotations[0].text"]
    html = plot.page_html(page)
    assert len(html) < 8e6
    assert "<title>Test</title>" in html
    assert html == plot.page_html(page)
    assert not re.search(r"<script[^>]+src=", html)  # works offline


def test_page_is_decimated_and_in_true_proportions():
    truth = surface(90, 60)
    mask = torch.ones(1, 1, 90, 60, dtype=torch.bool)
    mask[..., :30] = False
    page = plot.surface_page({"z": truth}, mask=mask, pixel_size=(2.0, 0.5), max_side=30)
    trace = page.data[0]
    np.testing.assert_allclose(trace.z[:, 10:], truth[0, 0, ::3, 30::3] - 0.0, atol=1e-4)
    assert np.isnan(trace.z[:, :10]).all()
    assert (trace.x[1], trace.y[1]) == (6.0, -1.5)  # y up
    aspect, span = page.layout.scene.aspectratio, page.layout.scene.zaxis.range
    assert aspect.x / aspect.y == pytest.approx(120 / 45)
    assert aspect.z / aspect.x == pytest.approx((span[1] - span[0]) / 120)
    flat = plot.surface_page({"z": truth / 1000})
    assert "raised" in flat.layout.scene.zaxis.title.text
    assert flat.layout.scene.aspectratio.z == pytest.approx(0.125)


def test_a_page_of_points_lies_where_they_do():
    points = torch.randn(1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    (trace,) = plot.surface_page({"z": points}).data
    for axis, found in enumerate((trace.x, trace.y, trace.z)):
        np.testing.assert_allclose(found, points[0, axis], atol=1e-6)


def test_the_title_and_buttons_of_the_page_are_text_that_breaks():
    """Nothing of them is left in the drawing, where a narrow window would cut it off."""
    page = plot.surface_page({"a": surface(), "b <": noisy()}, notes={"a": "first"}, title="A & B")
    html = plot.page_html(page)
    header = html[html.index("<header>") : html.index("</header>")]
    assert header.count("<h1>A &amp; B</h1>") == 1
    assert re.findall(r"<button>(.*?)</button>", header) == ["a", "b &lt;"]
    assert len(re.findall(r"<p( hidden)?>", header)) == 2
    assert '"updatemenus"' not in html.partition("Plotly.newPlot")[2]
    assert "A & B" not in html
    assert "<button>" not in plot.page_html(plot.surface_page({"a": surface()}))


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "match, call",
    [
        ("heights: none given", lambda z: plot.compare_heights(z, {})),
        (r"b: shape \(1, 1, 40, 59\)", lambda z: plot.compare_heights(z, {"b": z[..., 1:]})),
        ("no valid pixel", lambda z: plot.surface_page({"a": z * torch.nan})),
        ("max_side: 1", lambda z: plot.surface_page({"a": z}, max_side=1)),
        (r"height: shape \(1, 60\)", lambda z: plot.hillshade(z[0, 0, :1])),
        ("quantity: 'width'", lambda z: plot.surface_preview(z, quantity="width")),
        (r"jump: shape \(1, 1, 40, 60\)", lambda z: plot.surface_preview(z, jump=z)),
    ],
)
def test_bad_input_names_the_argument(match, call):
    with pytest.raises(ValueError, match=match):
        call(surface())


@pytest.mark.parametrize(
    "library, call", [("matplotlib", lambda z: plot.compare_heights(None, z)), ("plotly", plot.surface_page)]
)
def test_a_missing_library_names_the_extra(monkeypatch, library, call):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=r"pip install 'torchdls\[plots\]'"):
        call({"z": surface()})
