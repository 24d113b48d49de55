import time,numpy as np, sys
from filtergym.evaluation.likelihood import *
from filtergym.envs.catalogue import read_recording, make_task, task_class
from filtergym.baselines.maneuvering_target.log_families import log_families
from scipy.optimize import minimize
ID="filtergym/ManeuveringTarget-v0"; cls=task_class(ID)
rec=read_recording(f"/tmp/logs/{sys.argv[1]}.csv",ID,speeds=(0.01,1000))
task=make_task(cls,**rec.parameters)
N=int(rec.rows[0]); nb=max(8,min(24,N//40)); nb-=nb%4
cut=[N*i//nb for i in range(nb+1)]
w=cut_windows(rec,task,[Span(0,cut[i],cut[i+1]) for i in range(0,nb,2)],20)
print(N,nb,w.counts.shape,w.counts.sum())
for name,t in log_families(rec).items():
    t0=time.time(); L=WindowLikelihood(task,w,t.start,t.apply); t1=time.time()
    x0=np.array(list(t.start.values())); f0=L.gradient(x0); t2=time.time(); L.gradient(x0); t3=time.time()
    B=list(t.limits.values()); best=None
    for s in range(3):
        lo,hi=np.array(B).T; x=x0 if s==0 else lo+(hi-lo)*np.random.default_rng(s).random(len(lo))
        r=minimize(lambda v: tuple(-a/L.count for a in L.gradient(v)),x,jac=True,method="L-BFGS-B",bounds=B,options=dict(maxiter=60,ftol=1e-10))
        if best is None or r.fun<best.fun: best=r
    print(name,"first",round(t1-t0,2),round(t2-t1,2),"grad",round(t3-t2,4),"fit",round(time.time()-t3,2),r.nfev,"ll",-best.fun,-f0[0]/L.count,dict(zip(t.limits,best.x.round(2))),flush=True)
