"""What a policy's encoder makes of its past: how well terrains and commands can be told apart in it (``docs/guides/latent.md``).

``collecting`` walks and notes latents and the experts' weights, ``separation`` says in numbers how well conditions separate,
``study`` does both for several policies and writes files, ``figures`` draws.
"""
