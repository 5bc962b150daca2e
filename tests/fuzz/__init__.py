"""Random calls of everything public, each as one line of Python, judged by oracles that hold for any input.

    python -m tests.fuzz                        2,000 cases, as the tests run them
    python -m tests.fuzz --cases 20000 --seed 7
    python -m tests.fuzz --seed 7 --only 1234   one case again, with its call as code

Case i of seed s is drawn from `random.Random("s:i")`, and its tensors from seeds that stand in the code: the same case
on every machine. The targets are the integrators and learners of the registry, `solve`, the photometric methods, the
files and every other public function (`tests/fuzz/functions.py` has a list that is compared with `torchdls.__all__`).

The oracles, of which every case meets the first five and one of the others, drawn by chance:

- **errors**: a call that cannot be served raises a ValueError or TypeError whose message names an argument; the one
  that was spoilt, where one was. Nothing else is ever raised, nothing runs longer than a minute, and the only warning
  is `ConvergenceWarning`. Input that is in order raises nothing: but a height beyond its dtype says that it is not
  finite, and only where slopes, weights or anchors were drawn beyond 1e15.
- **finite**: no NaN and no infinite value comes out.
- **form**: dtype, device and shape are those of the input; heights are 0 outside the mask.
- **unwritten**: every tensor that went in holds the same values afterwards, at the same version.
- **twice**: the same call again gives the same bits.
- **equivariant**: the scale of the slopes, a flip, a transposition, the unit of length and an offset of all anchors
  pass through (but where `METHODS` of `tests/helpers/methods.py` says that a method does not promise it, and why).
- **batch**: each surface of a batch comes out as it does alone, of strided, expanded and negative views as of a copy.
- **outside**: NaN outside the mask changes nothing.
- **anchors**: a component that is anchored at one pixel passes through that anchor, of whatever weight (DLS, whose
  patches pull too, from a weight of 1e6); anchors of weight 1e6 and more are met everywhere.
- **truth**: `solve` and `LeastSquares` against an exact solution in rational numbers, weights of edges 1e-9..1e12.
- **laws** of single functions: there and back, adjoints, costs that never rise, scales (`tests/fuzz/functions.py`).

Drawn on purpose: sizes from 1 x 1, one row or column, masks of islands, corridors and lone pixels, both dtypes, slopes
of 1e-20 to 1e20, weights of edges and anchors from 1e-9 to 1e12, anchors 1e6 away, zero weights, flat fields, jumps,
wrong shapes, channels, dtypes, devices and types, options out of range.
"""
