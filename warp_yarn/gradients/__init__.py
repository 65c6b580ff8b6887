"""The adjoint of a run, and runs as functions of torch tensors. With ``calibration`` the only place of torch."""
