"""Learning what cloth is made of from recorded motion, with uncertainties."""
