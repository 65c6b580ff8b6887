"""Learning what cloth is made of from recorded motion, with uncertainties. ``learn`` is the way in.

``parameters`` says what can be learned, ``problem`` makes runs of it, ``differences`` their Jacobian,
``levenberg_marquardt`` looks for the values, ``uncertainty`` and ``probing`` say how sure they are, ``checkpoint``
keeps the search in a file. Torch, by rollouts, is in ``problem``, SciPy in ``levenberg_marquardt``.
"""
