import os

# torch.compile would start a pool of processes, which import PyTorch first, in every process that
# compiles: for the few small graphs of a test that takes longer than it saves.
os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
# Nor need it compile programs to find out which vectors this processor has: it knows them.
os.environ.setdefault("TORCHINDUCTOR_VEC_ISA_OK", "1")
