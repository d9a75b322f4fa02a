"""The pretrained policies that ship, so that a first table takes minutes.

Each lies in a folder as pretraining leaves one in the cache: the weights as safetensors, the sizes, and a
manifest with all that they were made from. It is used as long as the installed source and versions are those;
else, and for other scenarios and seeds, a policy is pretrained on first use, as this one was, with

    python -m clbench.pretrained clbench/Fetch-v0 --seed 0
"""
