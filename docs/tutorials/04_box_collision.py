# %% [markdown]
# # Box collision in MuJoCo
#
# The paper's robot experiment: a box is pushed into another one, and friction and mass
# are to be found from where the boxes come to rest. The simulator is MuJoCo, the
# "real" system the same with hidden parameters.
#
# Reduced sizes: two trials with few simulations, some seconds. The committed result,
# ten campaigns a target with six trials each, stands in [box
# collision](../benchmarks.md#box-collision).

# %%
from sbi_active import Campaign, CampaignOptions
from sbi_active.tasks import get_task

task = get_task("box_collision")
print(task.parameter_names, task.theta_true)
print(task.actions)

# %%
options = CampaignOptions(network="on demand", num_samples=64)
campaign = Campaign(task.simulator, task.prior, task.actions, seed=0, options=options)
for _ in range(2):
    trial = campaign.ask()
    campaign.tell(task.real_system(trial.action))
belief = campaign.update()
print(belief)

# %%
_ = campaign.plot(theta_true=task.theta_true, num_predicted=16)
# %% [markdown]
# What limits the belief is said with it. Two pushes determine the density and leave
# the two frictions wide; six do more, see the committed result.

# %%
print(belief.diagnostics)

# %% [markdown]
# The first push, as the belief's mean has it. A picture is drawn where there is a
# display or an offscreen renderer (EGL or OSMesa); the text of the error names what to
# install.

# %%
import tempfile
from base64 import b64encode
from pathlib import Path

from IPython.display import HTML

from sbi_active.tasks.box_collision import render

path = Path(tempfile.mkdtemp()) / "push.gif"
try:
    render(belief.mean, campaign.history[0].action, path)
    film = b64encode(path.read_bytes()).decode()
    alt = "Animation: a pusher drives one box into another, which slides and stops"
    shown = f'<img alt="{alt}" src="data:image/gif;base64,{film}">'
except RuntimeError as error:
    shown = f"<p>No picture here: {error}</p>"
HTML(shown)
