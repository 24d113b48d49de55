import time,sys
from filtergym.baselines.advice import advise
from filtergym.baselines.problem import problem_of
from filtergym.envs.catalogue import read_recording
from filtergym.names import find_competitor
from filtergym.agents.settings import *
ID="filtergym/ManeuveringTarget-v0"; p=problem_of(ID)
rec=read_recording(f"/tmp/logs/{sys.argv[1]}.csv",ID,speeds=(0.01,1000))
names=[n for n in [*p.baselines.policies,*p.baselines.estimators,*p.tuned,"bptt","ppo","kalman-net"] if n!="random"]
t=time.time()
a=advise(p,rec,{n:find_competitor(p,n) for n in names},progress=lambda w,s:print(w,round(s,2),round(time.time()-t,1),flush=True))
print(round(time.time()-t,1),"advised",a.advised.name,"best shipped",a.best_shipped, "share",[sum(s.last-s.first for s in x) for x in a.share[:3]])
for c in a.competitors: print(f"{c.name:32s} {c.parameters} ll {c.log_likelihood:.3f} d {c.difference.value:+.3f} [{c.difference.low:+.3f},{c.difference.high:+.3f}] pred {c.prediction:.3f} err {c.error:.3f} rel {100*c.relative_error.value:+.1f} [{100*c.relative_error.low:+.1f},{100*c.relative_error.high:+.1f}] nis {c.nis:.2f} acf {c.correlation.value:+.2f} [{c.correlation.low:+.2f},{c.correlation.high:+.2f}]")
for k,v in a.intervals.items(): print(k,a.fits[a.advised.name].values[k],v)
