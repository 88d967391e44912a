"""What a machine is: its chain of joints, the ports where errors enter, plans, parameters.

Uses `numerics`, `distributions` and `units`. Effects, instruments and the model stand on it.
"""
