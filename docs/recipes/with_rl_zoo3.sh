# PPO of rl-zoo3 with our hyperparameters, and its best model against the paper's policy.
#
#     sh docs/recipes/with_rl_zoo3.sh
set -e
ID=filtergym/ManeuveringTarget-v0 STEPS=20000 EPISODES=200 LOGS=$(mktemp -d)

python -m rl_zoo3.train --algo ppo --env $ID --gym-packages filtergym \
    --conf-file agents/hyperparameters/ppo.yml -params n_envs:16 batch_size:400 \
    --n-timesteps $STEPS --eval-freq 10000 --seed 0 --verbose 0 --log-folder $LOGS

python - << END
import filtergym

names = {"mine": "$LOGS/ppo/filtergym-ManeuveringTarget-v0_1", "imm": "imm"}  # a run's folder: its best model
cost = filtergym.evaluate("$ID", names, episodes=$EPISODES, trust=True)["cost"].mean(["episode", "time"])
print(f"cost against the paper's algorithm: {cost[0] / cost[1] - 1:+.1%}")
END
