"""What is installed as `cmedirl`: demonstrations, and what a run has learned."""
