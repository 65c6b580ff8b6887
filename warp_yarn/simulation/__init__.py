"""Running a scene: the simulator, states and trajectories, and what one may look into.

``simulator.py`` is what users call. It checks (``checks.py``), lets one thread in at a time (``alone.py``), and hands
on: steps to ``stepper.py``, which is whole after any exception, and in parts to ``substepping.py``; copies from and to
the device to ``frames.py``; forces, energies and the linear system to ``inspection.py``; failures to ``diagnosis.py``.
It imports the rooms of descriptions, devices and integrators, and of io how files are written.
"""
