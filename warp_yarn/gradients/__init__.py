"""The adjoint of a run, and runs as functions of torch tensors. With ``calibration`` the only place of torch.

``adjoint`` goes back over steps, ``checkpoints`` keeps the states that it needs, ``parts`` those of steps that were
made in parts, ``inputs`` checks what a run is given, ``run`` makes and takes back a run on the device, ``rollout``
tells torch of it, ``fabric`` learns within ranges. Users import ``warp_yarn.torch``.
"""
