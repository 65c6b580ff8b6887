"""The paper's yarns and scene, and fabrics by name."""
