"""The learner's state, its one update step, and the policy it yields."""
