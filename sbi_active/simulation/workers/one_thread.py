"""One thread for whoever imports this: there is a worker a core.

The server of forks imports it, so that no worker has to look for its libraries.
"""

import torch
from threadpoolctl import threadpool_limits

torch.set_num_threads(1)
threadpool_limits(1)
