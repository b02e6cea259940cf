"""Robots: kinematics, identification from measured data, compensation.

Lengths are in mm, angles in rad, joint values (m, n) as the controller has them::

    from stcal import robot

    nominal = robot.load_robot("robot.toml")
    plan = robot.design(nominal, robot.DesignOptions(count=40))  # plan.q: joint vectors to measure at
    data = robot.read_measurements("measured.csv", nominal)
    found = robot.identify(nominal, data, robot.IdentifyOptions(sigma_mm=0.03, folds=6))
    print(found.rank, found.held_out.position_mm.mean(), found.covariance.shape)
    robot.save_robot("identified.toml", found.robot)

    base_from_tool = robot.forward(found.robot, data.q)  # m poses at once; .matrix() is (m, 4, 4)
    jacobian = robot.jacobian(found.robot, data.q)  # (m, 6, n)
    solved = robot.inverse(found.robot, base_from_tool, data.q)  # solved.q, solved.status
    targets = robot.read_targets("targets.csv", nominal)
    compensated = robot.compensate(found.robot, targets, nominal)  # compensated.found.q
    check = robot.verify(robot.read_measured("verified.csv"))  # check.sets[0].mean_mm, .max_mm
    axes = robot.robot_from_sweeps(robot.read_measurements("sweeps.csv", nominal), nominal)  # axes.robot
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
