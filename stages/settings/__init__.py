"""Settings of every stage, one module each.

They import pydantic and nothing heavier, so that a plan, a preset listing or an error about an
unknown key is answered without loading torch.
"""
