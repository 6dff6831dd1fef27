"""The soak: attacks on the promise that a success lies on the manifold (`make soak`)."""
