"""Chains of every kind, with rows of q, and what they return row by row."""

import numpy as np
import torch
from saved_models import arm, bent_chain, elastic_chain, tendon_chain, trunk, trunk_log

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, RigidChain

Q = trunk_log(24)[0]
TENDONS = np.linspace(-0.002, 0.002, 21).reshape(3, 7)
JOINTS = np.linspace(-1.0, 1.0, 9).reshape(3, 3)
MARKED = tendon_chain().with_markers([(0, 0.5, (0.01, 0.0, 0.0)), (1, 1.0)])
STAGE = ConstantCurvatureChain([0.05] * 2, n_actuators=[1, 3], lengths=[None, 0.1], routing="base")
ROTATION = ConstantCurvatureChain(
    [0.05] * 2, n_actuators=[1, 3], lengths=[None, 0.1], routing="base", stage="rotation"
)
CHAINS = {
    "trunk": (trunk(), Q[:3]),
    "tendons": (bent_chain(), TENDONS),
    "gains": (tendon_chain(gains=[0.001, -0.002]), TENDONS),
    "pair": (ConstantCurvatureChain([0.05], n_actuators=2, angles=[0.0, np.pi]), Q[:3, :2]),
    "stage": (STAGE, np.tile([0.1, 0.01, 0.0, -0.01], (3, 1))),
    "rotation": (ROTATION, np.tile([0.5, 0.01, 0.0, -0.01], (3, 1))),
    "marked": (MARKED, TENDONS),
    "tip": (bent_chain().with_tip(1.5), TENDONS),
    "elastic": (elastic_chain(), TENDONS),
    "many tendons": (ElasticTendonChain([0.005] * 5, [0.05] * 5), np.tile(TENDONS, 3)[:, :15]),
    "arm": (arm(), JOINTS),
}
ROW_BY_ROW = {
    Chain: "forward jacobian forward_and_jacobian pose pose_jacobian pose_and_jacobian poses "
    "backbone geometry_jacobian domain_distance in_domain " + more
    for Chain, more in {
        ConstantCurvatureChain: "arcs metres consistency contradictory",
        ElasticTendonChain: "arcs metres tensions slack",
        RigidChain: "",
    }.items()
}
# Its first derivative by torch.func loads SymPy, which sets a warning filter: not of this package.
_tangent = {"base": torch.ones(1, 4, 4, dtype=torch.float64)}
CHAINS["pair"][0].geometry_jacobian(torch.tensor(CHAINS["pair"][1]), _tangent)
CHAINS["arm"][0].geometry_jacobian(torch.tensor(CHAINS["arm"][1]), _tangent)
