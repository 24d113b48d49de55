# PPO of rl-zoo3 with our hyperparameters, and its best model against the paper's policy.
#
#     sh docs/recipes/with_rl_zoo3.sh
set -e
ID=filtergym/ManeuveringTarget-v0 STEPS=20000 EPISODES=200 LOGS=$(mktemp -d)

python -m rl_zoo3.train --algo ppo --env $ID --gym-packages filtergym --env-kwargs "control:'evidence'" \
    --conf-file agents/hyperparameters/ppo.yml -params n_envs:16 batch_size:400 \
    --n-timesteps $STEPS --eval-freq 10000 --seed 0 --verbose 0 --log-folder $LOGS

python -m filtergym evaluate $ID --policy imm --policy $LOGS/ppo/filtergym-ManeuveringTarget-v0_1 --trust --episodes $EPISODES
