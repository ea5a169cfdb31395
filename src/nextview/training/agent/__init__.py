"""From predictions to a policy by reinforcement learning."""
