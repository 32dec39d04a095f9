"""Methods of other papers that the paper compares with (tables 1 and 3), on the same features, data and evaluation.

Written from the papers. What all of them leave out: the text, whose place the scene takes (the paper's supplement 6.2),
and a fit of body parameters to joints, since the features hold rotations.
"""
