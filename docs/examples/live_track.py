"""A radar track in your own loop: start, update, predict, save, restore."""

import pickle

import filtergym
import numpy

filter = filtergym.online("filtergym/ManeuveringTarget-v0", "kalman-imm-turn", sampling_interval=4.0)
filter.start(
    mean=[21_000.0, 30_500.0, -180.0, 40.0],  # x, y (m), their rates (m/s)
    covariance=numpy.diag([150.0, 150.0, 40.0, 40.0]) ** 2,
    time=0.0,
)

plots = [(4.0, 20_310.0, 30_640.0), (8.0, 19_550.0, 30_830.0), (12.0, None, None), (15.9, 18_160.0, 31_120.0)]
for time, x, y in plots:
    estimate = filter.update(time, x=x, y=y)  # a scan that missed the target has neither
    print(f"{time:5.1f} s  x {estimate['position_x']:.0f} m ± {estimate.sigma[0]:.0f}, NIS {estimate.nis:.2f}")

print("in five seconds:", filter.predict(20.9))

state = pickle.dumps(filter.save())  # to a file, or to another process
again = filtergym.online("filtergym/ManeuveringTarget-v0", "kalman-imm-turn", sampling_interval=4.0)
again.restore(pickle.loads(state))
assert (again.update(20.0, x=17_480.0, y=31_300.0).mean == filter.update(20.0, x=17_480.0, y=31_300.0).mean).all()

# Many tracks side by side: the tracks are the last axis, and a new one can replace another.
many = filtergym.online("filtergym/ManeuveringTarget-v0", "imm", tracks=2)
start = numpy.array([[21_000.0, 30_500.0, -180.0, 40.0], [5_000.0, 8_000.0, 90.0, 0.0]]).T
spread = numpy.repeat(numpy.diag([2e4, 2e4, 1e3, 1e3])[:, :, None], 2, axis=2)
many.start(start, spread)
print(many.update(4.0, x=[20_310.0, 5_400.0], y=[30_640.0, numpy.nan])["position_x"])
many.start(start, spread, time=4.0, tracks=[1])
