"""Gymnasium environments: learn, or judge, a policy of your own. Importing this registers them; docs/environments.md.

- ``nextview/Recognise-v0``: over a file of predictions, thousands of episodes in one batch, nothing is rendered.
- ``nextview/RecogniseMesh-v0``: over meshes, rendered and shown to the networks as the agent goes.
- ``nextview/ActiveRecognise-v0``: the first as an ``ActiveClassificationEnv`` of ap_gym; needs that package.
"""

import gymnasium

gymnasium.register(
    "nextview/Recognise-v0",
    entry_point="nextview.envs.recognise_env:RecogniseEnv",
    vector_entry_point="nextview.envs.vector_env:RecogniseVectorEnv",
)
gymnasium.register("nextview/RecogniseMesh-v0", entry_point="nextview.envs.mesh_env:RecogniseMeshEnv")
gymnasium.register(
    "nextview/ActiveRecognise-v0",
    entry_point="nextview.envs.active_classification:ActiveRecogniseEnv",
    vector_entry_point="nextview.envs.active_classification:ActiveRecogniseVectorEnv",
)
