"""Episodes of a deployment in virtual time, in which a policy decides: for training, evaluation and comparison.

``setting`` configures episodes and fits; ``episode`` draws single decisions and carries out choices by real field fits;
``rollout`` lets an actor decide, there or in a running deployment, on the engine.
"""
