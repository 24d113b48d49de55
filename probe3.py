import time,numpy as np, sys
from filtergym.evaluation.likelihood import *
from filtergym.envs.catalogue import read_recording, make_task, task_class
from filtergym.baselines.maneuvering_target.log_families import log_families
from filtergym.baselines.fitting import *
ID="filtergym/ManeuveringTarget-v0"; cls=task_class(ID)
rec=read_recording(f"/tmp/logs/{sys.argv[1]}.csv",ID,speeds=(0.01,1000))
task=make_task(cls,**rec.parameters)
N=int(rec.rows[0]); nb=max(8,min(24,N//40)); nb-=nb%4
cut=[N*i//nb for i in range(nb+1)]
w=cut_windows(rec,task,[Span(0,cut[i],cut[i+1]) for i in range(0,nb,2)],20)
scaled=lambda m,f: m._replace(variance=m.variance*f**2)
T0=time.time()
for name,t in log_families(rec).items():
    t=with_noise_scale(t,scaled)
    t0=time.time(); L=WindowLikelihood(task,w,t.start,t.apply); f=fit(L,t); t1=time.time(); I=profile_intervals(L,t,f); t2=time.time()
    print(name,round(t1-t0,2),round(t2-t1,2),round(f.log_likelihood/f.count,4),"spread",round(f.spread,2),f.at_limit)
    for k,v in f.values.items(): print("    ",k,round(v,3),[round(x,3) for x in I[k][:2]],I[k][2:])
print(time.time()-T0)
