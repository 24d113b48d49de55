"""An encoder with 0.1 rad of noise and an extended Kalman filter around Gymnasium's pendulum."""

import gymnasium as gym
import numpy as np

from filtergym.wrappers import EstimatedObservation, NoisyObservation

env = NoisyObservation(gym.make("Pendulum-v1"), {"encoder": {"h": "angle", "R": 0.1**2}})
env = EstimatedObservation(env, competitor="extended")
(cosine, sine, rate), info = env.reset(seed=0)
total, ended = 0.0, False
while not ended:
    near, energy = cosine > 0.85, rate**2 / 6 + 5 * cosine - 5
    torque = -20 * np.arctan2(sine, cosine) - 5 * rate if near else -2 * np.sign(rate * energy)
    (cosine, sine, rate), reward, _, ended, info = env.step(np.clip([torque], -2, 2))
    total += reward
print(f"return {total:.0f}, angle {env.estimates.mean[0, 0]:.2f} ± {env.estimates.deviation[0, 0]:.2f} rad")
