import time,filtergym,sys
from filtergym.baselines.problem import problem_of
from filtergym.envs.catalogue import read_recording
ID="filtergym/ManeuveringTarget-v0"; p=problem_of(ID)
rec=read_recording("/tmp/logs/drive.csv",ID,speeds=(0.01,1000))
for n in [*p.baselines.policies,*p.baselines.estimators,*p.tuned,"bptt","ppo","kalman-net"]:
    t=time.time(); d=p.evaluate({n:__import__("filtergym.names",fromlist=["x"]).find_competitor(p,n)},rec); a=time.time()-t
    import numpy as np
    e=np.sqrt((d.error.values[0,0,:,:2]**2).sum(-1).mean()); ll=np.nanmean(d.log_likelihood.values) if "log_likelihood" in d else float('nan')
    print(n,round(a,2),round(e,3),round(float(ll),3),flush=True)
