import time,common,numpy as np
from people import make_dressed
from posing import fit
import postures
from postures import POSTURES, make_posture
from posing import *
t=time.time()
stat={}
for i in range(4):
    d=make_dressed(np.random.default_rng(i+20),'x'); f=fit(d.body)
    print(f.hip,f.leg,f.arm,f.shoulder,f.ear,f.surface(f.hip+.2), f.wide(f.hip+.1))
    for n in POSTURES:
        rng=np.random.default_rng(i)
        ok=0; c=[];low=[];b2=[]
        for k in range(6):
            s=POSTURES[n](f,rng); postures._settle(f,s.pose); rot,pos=solve_pose(f.body,s.pose,s.lift,s.pull)
            c.append(self_contact(f,pos)); posed=bare(f.body,rot,pos); low.append(posed[:,2].min())
            pr=s.things(f,rot,pos,posed) if s.things else []
            body=posed[f.body.weight_of("finger", "metacarpal", "wrist")<.5]
            b2.append(max([(int(((p.inside(posed if not p.held else body))>.025).sum()),p.name) for p in pr if p.centre is not None],default=0))
        t0=time.time(); m=make_posture(f,n,rng); 
        print(n,np.round(c,3),np.round(low,3),b2,'made' if m else 'FAIL',round(time.time()-t0,2))
