"""How fast cmedirl_jax is, and beside whom."""
