"""Measure how well terrains and commands can be told apart in the latent of a policy's encoder (``docs/guides/latent.md``).

``collecting`` walks and notes latents and the experts' weights, ``separation`` says in numbers how well conditions separate,
``study`` does both for several policies and writes files, ``figures`` draws.
"""
