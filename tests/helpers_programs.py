"""Stand-ins for programs that the benchmark's wrappers run: their interface as published, not their work.

Each finds the transform between two clouds of the same points in any order, by their distances from the
centroid, in the frame and scale in which it is given them. Each refuses input that the real program refuses.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from mtpcr_geo.benchmark.baselines.fpfh import best_rigid

POINTS = 80
SPACING_M = 3.0


def scattered(rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points no two of which share a cell of any thinning up to 1.5 m, metres, about the origin."""
    out: list[np.ndarray] = []
    while len(out) < POINTS:
        point = rng.uniform((-30.0, -30.0, -6.0), (30.0, 30.0, 6.0))
        if all(np.linalg.norm(point - other) > SPACING_M for other in out):
            out.append(point)
    return np.array(out)


def solved(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """4x4 that takes the points of one cloud to those of the other."""
    order = [
        np.argsort(np.linalg.norm(xyz - xyz.astype(float).mean(axis=0), axis=1)) for xyz in (source, target)
    ]
    return best_rigid(source[order[0]].astype(float), target[order[1]].astype(float))


def write(folder: Path, files: dict[str, str]) -> Path:
    """Write a stand-in's files."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    return folder


SOLVING = """
import numpy as np

def solved(source, target):
    a, b = (xyz[np.argsort(np.linalg.norm(xyz - xyz.mean(axis=0), axis=1))].astype(float)
            for xyz in (np.asarray(source, float), np.asarray(target, float)))
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    U, _, Vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = mean_b - T[:3, :3] @ mean_a
    return T
"""

# as its ply reader has it: float32, six columns; its output as its main function writes it
PLADE = """
    #!{python}
    import sys
    sys.path.insert(0, {folder!r})
    import numpy as np
    from solving import solved
    target, source, result = sys.argv[1:]
    output = open(result, "w")

    def read(path, name):
        head, _, body = open(path, "rb").read().partition(b"end_header\\n")
        wanted = "".join(f"property float {{axis}}\\n" for axis in "x y z nx ny nz".split())
        if not head.startswith(b"ply\\nformat binary_little_endian 1.0\\n") or wanted.encode() not in head:
            print("loading", name, "point cloud failed", file=sys.stderr)
            print("registration failed", file=sys.stderr)
            output.write("registration failed, an identity matrix is recorded:\\n" + str(np.eye(4)))
            output.close()
            sys.exit(1)
        table = np.frombuffer(body, "<f4").reshape(-1, 6)
        assert np.allclose(np.linalg.norm(table[:, 3:], axis=1), 1, atol=1e-5)
        return table[:, :3]

    fixed = read(target, "target")
    T = solved(read(source, "source"), fixed)
    output.write(f"target: {{target}}\\nsource: {{source}}\\ntransformation:\\n")
    np.savetxt(output, T, "%.6g")
"""

TORCH = """
    import contextlib
    import numpy as np

    gradients = True

    class Tensor:
        def __init__(self, data):
            self.data = np.asarray(data)
        def __getitem__(self, part):
            return self.data[part]
        def cuda(self):
            raise AssertionError("Torch not compiled with CUDA enabled")
        def to(self, device):
            assert str(device) == "cpu"
            return self
        def long(self):
            return self
        def detach(self):
            return self
        cpu = contiguous = detach
        def numpy(self):
            return self.data
        def tolist(self):
            return self.data.tolist()

    class cuda:
        is_available = staticmethod(lambda: False)

    def ones(*shape):
        return Tensor(np.ones(shape))

    def device(name):
        return name

    def manual_seed(seed):
        pass

    def load(path, map_location=None, weights_only=True):
        assert not weights_only and map_location == "cpu", "old weights hold more than tensors"
        return {"model": open(path).read(), "state_dict": open(path).read()}

    @contextlib.contextmanager
    def no_grad():
        global gradients
        gradients = False
        yield
"""

MODEL = """
    class Model:
        training, weights = True, None
        def load_state_dict(self, weights):
            self.weights = weights
        def eval(self):
            self.training = False
            return self
        def to(self, device):
            return self
        def ready(self):
            import torch
            assert not torch.gradients, "gradients of all points fill the memory"
            assert self.weights == "trained"
"""

GEOTRANSFORMER = {
    "geotransformer/__init__.py": "",
    "geotransformer/utils/__init__.py": "",
    "geotransformer/utils/torch.py": """
        def to_cuda(batch):
            return {key: value.cuda() if hasattr(value, "cuda") else value for key, value in batch.items()}
        def release_cuda(batch):
            return batch
    """,
    "geotransformer/utils/data.py": """
        import numpy as np
        from torch import Tensor
        def calibrate_neighbors_stack_mode(dataset, collate, stages, voxel, radius):
            assert len(dataset) == 1 and collate is registration_collate_fn_stack_mode
            return [20] * stages
        def registration_collate_fn_stack_mode(dicts, stages, voxel, radius, neighbours):
            (one,) = dicts
            assert len(neighbours) == stages
            for role in ("ref", "src"):
                xyz = one[role + "_points"]
                assert xyz.dtype == np.float32 and one[role + "_feats"].shape == (len(xyz), 1)
                assert len(np.unique(np.floor((xyz - xyz.min(0)) / voxel), axis=0)) == len(xyz)
            lengths = [[len(one["ref_points"]), len(one["src_points"])]] * stages
            points = np.concatenate([one["ref_points"], one["src_points"]])
            return {"points": Tensor(points), "lengths": [Tensor(n) for n in lengths],
                    "transform": Tensor(one["transform"])}
    """,
}
EXPERIMENT = {
    "config.py": """
        from types import SimpleNamespace as Space
        def make_cfg():
            sizes = Space(init_voxel_size={voxel}, num_stages={stages}, init_radius={voxel} * 2.5)
            return Space(backbone=sizes)
    """,
    "model.py": MODEL
    + """
    import numpy as np
    from IPython import embed
    from solving import solved
    class GeoTransformer(Model):
        def __call__(self, batch):
            if self.training:
                return {"estimated_transform": batch["transform"].numpy()}
            self.ready()
            count = batch["lengths"][0].tolist()[0]
            points = batch["points"].numpy()
            return {"estimated_transform": solved(points[count:], points[:count])}
    def create_model(config):
        return GeoTransformer()
    """,
}

PREDATOR = {
    "configs/models.py": "architectures = {'indoor': ['simple', 'last_unary'], 'kitti': ['simple']}",
    "configs/test/indoor.yaml": "",
    "weights/indoor.pth": "trained",
    "lib/utils.py": """
        def load_config(path):
            sizes = dict(first_subsampling_dl=0.025, num_layers=4)
            return dict(dataset="indoor", pretrain="weights/indoor.pth", **sizes)
        def setup_seed(seed):
            pass
    """,
    "datasets/dataloader.py": """
        import numpy as np
        from torch import Tensor
        def calibrate_neighbors(dataset, config, collate_fn):
            assert len(dataset) == 1 and config.architecture
            return [20] * config.num_layers
        def collate_fn_descriptor(items, config, neighborhood_limits):
            ((src, tgt, src_feats, tgt_feats, rot, trans, *_),) = items
            assert src.dtype == np.float32 and src_feats.shape == (len(src), 1) and trans.shape == (3, 1)
            assert len(neighborhood_limits) == config.num_layers
            points = Tensor(np.concatenate([src, tgt]))
            return {"points": [points], "stack_lengths": [Tensor([len(src), len(tgt)])]}
    """,
    "models/architectures.py": MODEL
    + """
    import numpy as np
    from torch import Tensor
    class KPFCNN(Model):
        def __init__(self, config):
            assert config.device == "cpu" and config.architecture
        def __call__(self, inputs):
            assert not self.training
            self.ready()
            points, count = inputs["points"][0].numpy(), inputs["stack_lengths"][0][0]
            features = np.zeros((len(points), 4))
            for part in (slice(0, count), slice(count, None)):
                apart = np.linalg.norm(points[part] - points[part].mean(axis=0), axis=1)
                features[part, 0] = np.argsort(np.argsort(apart))
            ones = np.ones((len(points), 1))
            return Tensor(features), Tensor(ones), Tensor(ones)
    """,
}
EASYDICT = """
    class EasyDict(dict):
        __getattr__ = dict.__getitem__
        __setattr__ = dict.__setitem__
"""

SYLVA = {
    "sylva/__init__.py": """
        from . import fusion, ground
        class PointCloud:
            def __init__(self, xyz):
                self.xyz, self.classified = xyz, False
    """,
    "sylva/ground.py": """
        def classify_ground_pmf(cloud):
            cloud.classified = True
            return cloud
    """,
    "sylva/fusion.py": """
        import numpy as np
        from types import SimpleNamespace
        from solving import solved
        def register(tls, als, initial, *, search_radius):
            assert tls.classified and als.classified
            T = solved(tls.xyz, als.xyz)
            middle = np.append(tls.xyz.mean(axis=0), 1)
            assert np.linalg.norm((T @ middle - initial @ middle)[:2]) < search_radius < 100
            return SimpleNamespace(transform=T, report=lambda: "TLS to ALS registration")
    """,
}

MAP_CLOSURES = {
    "map_closures/__init__.py": "",
    "map_closures/config.py": """
        class MapClosuresConfig:
            inliers_threshold = 5
            def __init__(self, density_map_resolution):
                assert density_map_resolution == 1.0
    """,
    "map_closures/map_closures.py": """
        import numpy as np
        from types import SimpleNamespace
        from solving import solved
        class MapClosures:
            def __init__(self, config):
                self.maps = {}
            def get_best_closure(self, query_id, local_map):
                before = [key for key in self.maps if key < query_id - 3]
                self.maps[query_id] = local_map
                if not before:
                    return SimpleNamespace(pose=np.eye(4), number_of_inliers=0)
                pose = solved(self.maps[before[0]], local_map)
                return SimpleNamespace(pose=pose, number_of_inliers=40)
    """,
}

CODEM = {
    "codem/__init__.py": """
        from dataclasses import dataclass
        from types import SimpleNamespace
        import laspy
        from solving import solved
        @dataclass
        class CodemRunConfig:
            FND_FILE: str
            AOI_FILE: str
            DSM_SOLVE_SCALE: bool
            ICP_SOLVE_SCALE: bool
            LOG_TYPE: str
        class Cloud:
            def __init__(self, path):
                self.las = laspy.read(path)
                assert self.las.header.parse_crs().is_projected
            def prep(self):
                self.xyz = self.las.xyz
        def preprocess(config):
            return Cloud(config["FND_FILE"]), Cloud(config["AOI_FILE"])
        def coarse_registration(foundation, moving, config):
            return None
        def fine_registration(foundation, moving, coarse, config):
            return SimpleNamespace(registration_parameters={"matrix": solved(moving.xyz, foundation.xyz)})
    """,
    "codem/lib/__init__.py": "",
    "codem/lib/log.py": """
        class Log:
            def __init__(self, config):
                pass
    """,
}
