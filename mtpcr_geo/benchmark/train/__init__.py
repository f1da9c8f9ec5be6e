"""Train the learned matcher that the package ships, on simulated sites.

    python -m mtpcr_geo.benchmark.train OUT

`sites` simulates clouds of places with known pose, `views` makes images of them, `samples` cuts pairs of
patches with known correspondences, `networks` holds the two networks, `features` and `pairing` train them,
`export` writes them as ONNX files of the package's contract. Needs the extra ``train`` (PyTorch); a CPU does.
"""
