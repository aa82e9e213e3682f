// A world's solve, as the body of a Warp function (kernel.py puts the sizes in). On a GPU the 32 threads of a warp share the work,
// and what one of them writes for others to read lies in shared memory; on a CPU one thread does all of it, and what is said below
// of every thread is a loop.
//
// Per world: M qdd - tau - J' f = 0 is the minimum of 1/2 (qdd - qdd0)' M (qdd - qdd0) + s(J qdd - aref). The cost s of a row is
// quadratic where it is active, straight where joint friction slips, and 0 where a limit or contact is free; an elliptic contact
// that slides costs its distance from the cone (MuJoCo, "Computation", constraint model).
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float pool[$worlds][$floats];
    float* const memory = pool[threadIdx.x >> 5];
    const int lane = threadIdx.x & 31;
#define EACH(i, begin, end) for (int i = (begin) + lane; i < (end); i += 32)
#define DOFS(i) if (const int i = lane; i < $dofs)
#define PER_DOF(name) float name = 0.0f
#define OF(name, i) name
#define FROM(name, i) __shfl_sync(0xffffffffu, name, i)
#define SUM(x) _Pragma("unroll") for (int o = 16; o > 0; o >>= 1) x += __shfl_xor_sync(0xffffffffu, x, o)
#define SYNC __syncwarp()
    float line[$stride];
#define LINE(i, j) line[j]
    const auto dot = [](const float* a, const float* b) {
        float sum = 0.0f;
#pragma unroll
        for (int j = 0; j < $stride; j += 4) {
            const float4 x = *reinterpret_cast<const float4*>(a + j), y = *reinterpret_cast<const float4*>(b + j);
            sum += x.x * y.x + x.y * y.y + x.z * y.z + x.w * y.w;
        }
        return sum;
    };
    // adds a row's weighted square to line i of the Hessian
    const auto add = [&](int i, float weight, const float* row) {
        weight *= row[i];
#pragma unroll
        for (int j = 0; j < $stride; j += 4) {
            const float4 x = *reinterpret_cast<const float4*>(row + j);
            line[j] += weight * x.x;
            line[j + 1] += weight * x.y;
            line[j + 2] += weight * x.z;
            line[j + 3] += weight * x.w;
        }
    };
#else
    float memory[$floats];
#define EACH(i, begin, end) for (int i = (begin); i < (end); ++i)
#define DOFS(i) for (int i = 0; i < $dofs; ++i)
#define PER_DOF(name) float name[$dofs] = {}
#define OF(name, i) name[i]
#define FROM(name, i) name[i]
#define SUM(x)
#define SYNC
    float line[$dofs][$stride];
#define LINE(i, j) line[i][j]
    const auto dot = [](const float* a, const float* b) {
        float sum = 0.0f;
        for (int j = 0; j < $stride; ++j) sum += a[j] * b[j];
        return sum;
    };
    const auto add = [&](int i, float weight, const float* row) {
        weight *= row[i];
        for (int j = 0; j < $stride; ++j) line[i][j] += weight * row[j];
    };
#endif
    // in this order, and as much as kernel.py's Sizes.floats says; the first five vectors are cleared together below
    float* free_memory = memory;
    const auto take = [&](int numbers) {
        float* const taken = free_memory;
        free_memory += numbers;
        return taken;
    };
    float* const jacobian = take($staged * $stride); // rows of limits and contacts
    float* const inertia = take($dofs * $stride);
    float* const factor = take($dofs * $stride);     // column c of L D in row c
    float* const vector = take($stride);             // the acceleration at first, then the search direction
    float* const pivot = take($stride);              // 1 / D
    float* const dry_weight = take($stride);         // joint friction by degree of freedom: second derivative of its cost, …
    float* const dry_force = take($stride);          // … and force
    float* const loss = take($stride);               // largest joint friction, by row
    float* const weight = take($row_room);           // second derivative of a row's cost
    float* const force = take($row_room);
    float* const residual = take($row_room);         // J times acceleration, minus the reference
    float* const change = take($row_room);           // J times the search direction
    float* const stiffness = take($row_room);
#if $elliptic
    float* const friction = take($row_room);         // of a contact's row: what makes the cone round
    float* const size = take($row_room);             // rows of the contact whose first row this is, or 0
    float* const normal = take($stride);             // a contact's row of the normal, less …
    float* const tangent = take($stride);            // … its row along the slip
#endif

    // joint friction, limits, contacts, in this order; plain rows are those with a cost of their own
    const int rows = wp::min(problem.rows.data[world], $most_rows), dry = wp::min(problem.dry.data[world], rows);
#if $elliptic
    const int plain = wp::min(dry + problem.limits.data[world], rows);
#else
    const int plain = rows;
#endif
    const size_t first = size_t(world) * $most_rows, padded = size_t(world) * $padded_rows;
    const float* const all_rows = problem.jacobian.data + padded * $stride;
    const float tolerance = problem.tolerance.data[world % problem.tolerance.shape[0]];
    const float search_tolerance = problem.search_tolerance.data[world % problem.search_tolerance.shape[0]];
    const int staged = wp::min(rows, dry + $staged);

    // load
    EACH(e, 0, 2 * $dofs * $stride) inertia[e] = 0.0f;
    EACH(e, 0, 5 * $stride) vector[e] = 0.0f;
    EACH(e, 0, (staged - dry) * $stride) jacobian[e] = all_rows[dry * $stride + e];
    SYNC;
    float trace = 0.0f;
    EACH(e, 0, $elements) {
        const int i = problem.inertia_row.data[e], j = problem.inertia_column.data[e];
        const float value = problem.inertia.data[size_t(world) * $elements + e];
        inertia[i * $stride + j] = value;
        inertia[j * $stride + i] = value;
        trace += i == j ? value : 0.0f;
    }
    SUM(trace);
    const float scale = 1.0f / wp::max(trace, 1e-15f);
    PER_DOF(acceleration);
    PER_DOF(smooth);
    PER_DOF(momentum);    // M times acceleration
    PER_DOF(constrained); // force of the constraints
    DOFS(i) {
        const size_t at = size_t(world) * $dofs + i;
        OF(acceleration, i) = rows > 0 ? problem.start.data[at] : problem.smooth_acceleration.data[at];
        OF(smooth, i) = problem.smooth_force.data[at];
        vector[i] = OF(acceleration, i);
    }
    SYNC;
    DOFS(i) OF(momentum, i) = dot(inertia + i * $stride, vector);

    int iterations = 0;
    bool converged = true;
    if (rows > 0) {
        const auto along = [&](int r) {
            if (r < dry) return vector[problem.owner.data[first + r]];
            return r < staged ? dot(jacobian + (r - dry) * $stride, vector) : dot(all_rows + r * $stride, vector);
        };
        EACH(r, 0, rows) {
            stiffness[r] = problem.stiffness.data[padded + r];
            residual[r] = along(r) - problem.reference.data[first + r];
            if (r < dry) loss[r] = problem.loss.data[first + r];
        }
        // states in MuJoCo's order: satisfied, quadratic, linear on the negative side, linear on the positive side
        const auto state_at = [&](int r, float x) {
            if (r >= dry) return x < 0.0f ? 1 : 0;
            return stiffness[r] * x <= -loss[r] ? 2 : stiffness[r] * x >= loss[r] ? 3 : 1;
        };
        const auto force_at = [&](int r, int state, float x) {
            return state == 1 ? -stiffness[r] * x : state == 2 ? loss[r] : state == 3 ? -loss[r] : 0.0f;
        };
        const auto cost_at = [&](int r, int state, float x) {
            return state == 1 ? 0.5f * stiffness[r] * x * x
                : state == 0  ? 0.0f
                              : loss[r] * (fabsf(x) - 0.5f * loss[r] / stiffness[r]);
        };
        EACH(r, 0, plain) {
            const int state = state_at(r, residual[r]);
            weight[r] = state == 1 ? stiffness[r] : 0.0f;
            force[r] = force_at(r, state, residual[r]);
        }
#if $elliptic
        EACH(r, plain, rows) {
            const int contact = problem.owner.data[first + r];
            const int begin = problem.contact_row.data[contact * problem.contact_row.shape[1]];
            const int count = problem.contact_size.data[contact], part = r - begin;
            const auto frictions = problem.contact_friction.data[contact];
            // where rows overflow, some are counted that no contact has written
            const bool written = begin >= 0 && part >= 0 && part < count;
            size[r] = written && part == 0 ? static_cast<float>(wp::min(count, rows - r)) : 0.0f;
            friction[r] = !written ? 0.0f
                : part > 0         ? frictions[part - 1]
                : count == 1       ? 1.0f
                                   : frictions[0] * problem.impratio_root.data[world % problem.impratio_root.shape[0]];
            weight[r] = 0.0f;
            force[r] = 0.0f;
            change[r] = 0.0f;
        }
        SYNC;
        // a contact after a step, by the thread of its first row: 0 free, 1 sticks (all rows are quadratic), 4 slides
        struct Contact {
            int state, end;
            float mu, tangential, product, square, gap, weight;
        };
        const auto contact_at = [&](int r, float step) {
            Contact c;
            c.end = r + static_cast<int>(size[r]);
            c.mu = friction[r];
            const float pressed = c.mu * (residual[r] + step * change[r]);
            float sum = c.product = c.square = 0.0f;
            for (int t = r + 1; t < c.end; ++t) {
                const float x = friction[t] * (residual[t] + step * change[t]), v = friction[t] * change[t];
                sum += x * x;
                c.product += x * v;
                c.square += v * v;
            }
            c.tangential = sqrtf(sum);
            c.gap = pressed - c.mu * c.tangential;
            c.weight = stiffness[r] / wp::max(c.mu * c.mu * (1.0f + c.mu * c.mu), 1e-15f);
            if (c.tangential == 0.0f) c.state = pressed < 0.0f ? 1 : 0;
            else c.state = c.gap >= 0.0f ? 0 : c.mu * pressed + c.tangential <= 0.0f ? 1 : 4;
            return c;
        };
        const auto judge_contact = [&](int r, const Contact& c) {
            const float press = c.state == 4 ? -c.weight * c.gap * c.mu : 0.0f;
            for (int t = r; t < c.end; ++t) {
                const float x = residual[t], s = friction[t];
                weight[t] = c.state == 1 ? stiffness[t] : 0.0f;
                force[t] = c.state == 1 ? -stiffness[t] * x : 0.0f;
                if (c.state != 4) continue;
                weight[t] = t == r ? 0.0f : -c.weight * c.mu * c.gap / c.tangential * s * s;
                force[t] = t == r ? press : -press / c.tangential * x * s * s;
            }
        };
        EACH(r, plain, rows) if (size[r] > 0.0f) judge_contact(r, contact_at(r, 0.0f));
#endif
        PER_DOF(gradient);
        PER_DOF(direction);
        bool rebuild = true;
        float improvement = 0.0f;
        converged = false;
        while (true) {
            // gradient of the cost
            SYNC;
            EACH(r, 0, dry) {
                dry_weight[problem.owner.data[first + r]] = weight[r];
                dry_force[problem.owner.data[first + r]] = force[r];
            }
            SYNC;
            DOFS(i) {
                float sum = dry_force[i];
                for (int r = dry; r < staged; ++r)
                    if (force[r] != 0.0f) sum += force[r] * jacobian[(r - dry) * $stride + i];
                for (int r = staged; r < rows; ++r) sum += force[r] * all_rows[r * $stride + i];
                OF(constrained, i) = sum;
                OF(gradient, i) = OF(momentum, i) - OF(smooth, i) - sum;
            }
            if (iterations > 0) {
                float square = 0.0f;
                DOFS(i) square += OF(gradient, i) * OF(gradient, i);
                SUM(square);
                converged = scale * sqrtf(square) < tolerance || (improvement > 0.0f && scale * improvement < tolerance);
                if (converged || iterations == most_iterations) break;
            }
            if (rebuild) {
                // Hessian, line i in thread i, and its factors L D L'
                DOFS(i) {
#pragma unroll
                    for (int j = 0; j < $stride; ++j)
                        LINE(i, j) = inertia[i * $stride + j] + (i == j ? dry_weight[i] : 0.0f);
                    for (int r = dry; r < staged; ++r)
                        if (weight[r] != 0.0f) add(i, weight[r], jacobian + (r - dry) * $stride);
                    for (int r = staged; r < rows; ++r)
                        if (weight[r] != 0.0f) add(i, weight[r], all_rows + r * $stride);
                }
                SYNC;
#if $elliptic
                // contacts that slide: the rows' own weights, and two rows of the normal and the slip together
                for (int r = plain; r < rows; r += wp::max(static_cast<int>(size[r]), 1)) {
                    const Contact c = contact_at(r, 0.0f);
                    if (size[r] == 0.0f || c.state != 4) continue;
                    const auto entry = [&](int t, int j) {
                        return t < staged ? jacobian[(t - dry) * $stride + j] : all_rows[t * $stride + j];
                    };
                    EACH(j, 0, $stride) {
                        float sum = 0.0f;
                        for (int t = r + 1; t < c.end; ++t) sum += friction[t] * friction[t] * residual[t] * entry(t, j);
                        tangent[j] = sum / c.tangential;
                        normal[j] = entry(r, j) - tangent[j];
                    }
                    SYNC;
                    DOFS(i) {
                        add(i, c.weight * c.mu * c.mu, normal);
                        add(i, c.weight * c.mu * c.gap / c.tangential, tangent);
                    }
                    SYNC;
                }
#endif
#pragma unroll
                for (int c = 0; c < $dofs; ++c) {
                    DOFS(i) factor[c * $stride + i] = LINE(i, c);
                    SYNC;
                    const float inverse = 1.0f / wp::max(factor[c * $stride + c], 1e-15f);
                    EACH(one, 0, 1) pivot[c] = inverse;
                    DOFS(i) {
                        const float share = LINE(i, c) * inverse;
#pragma unroll
                        for (int j = c + 1; j < $dofs; ++j) LINE(i, j) -= share * factor[c * $stride + j];
                    }
                }
                SYNC;
            }
            // Newton's direction
            DOFS(i) OF(direction, i) = OF(gradient, i);
#pragma unroll
            for (int c = 0; c < $dofs - 1; ++c) {
                const float known = FROM(direction, c) * pivot[c];
                DOFS(i) if (i > c) OF(direction, i) -= factor[c * $stride + i] * known;
            }
            DOFS(i) OF(direction, i) *= pivot[i];
#pragma unroll
            for (int c = $dofs - 1; c > 0; --c) {
                const float known = FROM(direction, c);
                DOFS(i) if (i < c) OF(direction, i) -= factor[i * $stride + c] * pivot[i] * known;
            }
            float decrement = 0.0f, square = 0.0f;
            DOFS(i) {
                OF(direction, i) = -OF(direction, i);
                vector[i] = OF(direction, i);
                decrement -= OF(gradient, i) * OF(direction, i);
                square += OF(direction, i) * OF(direction, i);
            }
            SUM(decrement);
            SUM(square);
            if (iterations > 0 && scale * 0.5f * decrement < tolerance) {
                converged = true;
                break;
            }
            SYNC;
            // exact search along it: the slope of the cost rises along the line, for plain rows piece by piece straight
            PER_DOF(moved);
            float slope = 0.0f, curvature = 0.0f;
            DOFS(i) {
                OF(moved, i) = dot(inertia + i * $stride, vector);
                slope += OF(direction, i) * (OF(momentum, i) - OF(smooth, i));
                curvature += OF(direction, i) * OF(moved, i);
            }
            SUM(slope);
            SUM(curvature);
            EACH(r, 0, rows) change[r] = along(r);
            SYNC;
            const auto evaluate = [&](float step, float& first_derivative, float& second_derivative, float& gross) {
                float one = 0.0f, two = 0.0f, all = 0.0f;
                EACH(r, 0, plain) {
                    const float x = residual[r] + step * change[r];
                    const int state = state_at(r, x);
                    const float term = -force_at(r, state, x) * change[r];
                    one += term;
                    all += fabsf(term);
                    two += state == 1 ? stiffness[r] * change[r] * change[r] : 0.0f;
                }
#if $elliptic
                EACH(r, plain, rows) if (size[r] > 0.0f) {
                    const Contact c = contact_at(r, step);
                    if (c.state == 4) {
                        const float rate = c.product / c.tangential, bend = (c.square - rate * rate) / c.tangential;
                        const float approach = c.mu * (change[r] - rate);
                        one += c.weight * c.gap * approach;
                        all += fabsf(c.weight * c.gap * approach);
                        two += c.weight * (approach * approach - c.mu * c.gap * bend);
                    }
                    for (int t = r; t < (c.state == 1 ? c.end : r); ++t) {
                        const float term = stiffness[t] * (residual[t] + step * change[t]) * change[t];
                        one += term;
                        all += fabsf(term);
                        two += stiffness[t] * change[t] * change[t];
                    }
                }
#endif
                SUM(one);
                SUM(two);
                SUM(all);
                first_derivative = slope + step * curvature + one;
                second_derivative = curvature + two;
                gross = fabsf(slope) + all;
            };
            float step = 0.0f, descent, bend, gross;
            evaluate(0.0f, descent, bend, gross);
            const float accept = wp::max(wp::max(tolerance * search_tolerance * sqrtf(square) / scale, 1e-6f), 1e-6f * gross);
            if (descent < -1e-6f * gross && bend > 0.0f) {
                float low = 0.0f, high = -1.0f; // no upper bound yet
                step = -descent / bend;
                for (int trial = 0; trial < most_trials; ++trial) {
                    evaluate(step, descent, bend, gross);
                    if (fabsf(descent) <= accept) break;
                    if (descent < 0.0f) low = step;
                    else high = step;
                    float next = step - descent / bend;
                    if (!(next > low) || (high > 0.0f && !(next < high))) next = high > 0.0f ? 0.5f * (low + high) : 2.0f * step;
                    if (next == step) break;
                    step = next;
                }
            }
            ++iterations;
            // take the step
            DOFS(i) {
                OF(acceleration, i) += step * OF(direction, i);
                OF(momentum, i) += step * OF(moved, i);
            }
            float saved = 0.0f, flips = 0.0f;
            EACH(r, 0, plain) {
                const float x = residual[r], y = x + step * change[r];
                const int before = state_at(r, x), after = state_at(r, y);
                saved += before == 1 && after == 1 ? 0.5f * stiffness[r] * (x - y) * (x + y)
                                                   : cost_at(r, before, x) - cost_at(r, after, y);
                flips += before != after ? 1.0f : 0.0f;
                weight[r] = after == 1 ? stiffness[r] : 0.0f;
                force[r] = force_at(r, after, y);
                residual[r] = y;
            }
#if $elliptic
            EACH(r, plain, rows) if (size[r] > 0.0f) {
                const Contact before = contact_at(r, 0.0f), after = contact_at(r, step);
                flips += before.state != after.state || after.state == 4 ? 1.0f : 0.0f;
                for (int t = r; t < before.end; ++t) {
                    const float x = residual[t], y = x + step * change[t], half = 0.5f * stiffness[t];
                    saved += before.state == 1 && after.state == 1
                        ? half * (x - y) * (x + y)
                        : (before.state == 1 ? half * x * x : 0.0f) - (after.state == 1 ? half * y * y : 0.0f);
                    residual[t] = y;
                }
                const float one = before.state == 4 ? before.gap : 0.0f, two = after.state == 4 ? after.gap : 0.0f;
                saved += 0.5f * before.weight * (one - two) * (one + two);
                judge_contact(r, after);
            }
#endif
            SUM(saved);
            SUM(flips);
            improvement = saved - step * slope - 0.5f * step * step * curvature;
            rebuild = flips > 0.0f;
            if (step == 0.0f) {
                converged = true;
                break;
            }
        }
        SYNC;
        EACH(r, 0, rows) solution.row_force.data[first + r] = force[r];
        EACH(r, 0, plain) solution.state.data[padded + r] = state_at(r, residual[r]);
#if $elliptic
        EACH(r, plain, rows) if (size[r] > 0.0f) {
            const Contact c = contact_at(r, 0.0f);
            for (int t = r; t < c.end; ++t) solution.state.data[padded + t] = c.state;
        }
#endif
    }
    // store
    DOFS(i) {
        const size_t at = size_t(world) * $dofs + i;
        solution.acceleration.data[at] = OF(acceleration, i);
        solution.momentum.data[at] = OF(momentum, i);
        solution.constraint_force.data[at] = OF(constrained, i);
    }
    EACH(one, 0, 1) {
        solution.iterations.data[world] = iterations;
        if (!converged) solution.overflow.data[world] |= $limit_reached;
    }
    SYNC;
#undef EACH
#undef DOFS
#undef PER_DOF
#undef OF
#undef FROM
#undef SUM
#undef SYNC
#undef LINE
