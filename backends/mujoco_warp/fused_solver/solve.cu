// A world's solve, as the body of a Warp function (kernel.py puts the sizes in). On a GPU the 32 threads of a warp share the work,
// and what one of them writes for others to read lies in shared memory; on a CPU one thread does all of it, and what is said below
// of every thread is a loop.
//
// Per world: M qdd - tau + J' f = 0 is the minimum of 1/2 (qdd - qdd0)' M (qdd - qdd0) + s(J qdd - aref), with s quadratic where a
// row is active, straight where joint friction slips, and 0 where a limit or contact is free (MuJoCo, "Computation", constraint model).
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float pool[$worlds][$floats];
    float* const memory = pool[threadIdx.x >> 5];
    const int lane = threadIdx.x & 31;
#define EACH(i, begin, end) for (int i = (begin) + lane; i < (end); i += 32)
#define DOFS(i) if (const int i = lane; i < $dofs)
#define ROWS(begin, end) _Pragma("unroll") for (int k = 0; k < $row_slots; ++k) \
    if (const int r = 32 * k + lane; r >= (begin) && r < (end))
#define PER_DOF(name) float name = 0.0f
#define PER_ROW(name) float name[$row_slots]
#define OF(name, i) name
#define AT(name) name[k]
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
    const auto add = [&](int i, float factor, const float* row) {
        factor *= row[i];
#pragma unroll
        for (int j = 0; j < $stride; j += 4) {
            const float4 x = *reinterpret_cast<const float4*>(row + j);
            line[j] += factor * x.x;
            line[j + 1] += factor * x.y;
            line[j + 2] += factor * x.z;
            line[j + 3] += factor * x.w;
        }
    };
#else
    float memory[$floats];
#define EACH(i, begin, end) for (int i = (begin); i < (end); ++i)
#define DOFS(i) for (int i = 0; i < $dofs; ++i)
#define ROWS(begin, end) for (int r = (begin); r < (end); ++r)
#define PER_DOF(name) float name[$dofs] = {}
#define PER_ROW(name) float name[$most_rows]
#define OF(name, i) name[i]
#define AT(name) name[r]
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
    const auto add = [&](int i, float factor, const float* row) {
        factor *= row[i];
        for (int j = 0; j < $stride; ++j) line[i][j] += factor * row[j];
    };
#endif
    float* const jacobian = memory;                        // ($staged, $stride), rows of limits and contacts
    float* const inertia = jacobian + $staged * $stride;   // ($dofs, $stride)
    float* const factor = inertia + $dofs * $stride;       // ($dofs, $stride): column c of L D in row c
    float* const vector = factor + $dofs * $stride;        // ($stride): the acceleration at first, then the search direction
    float* const pivot = vector + $stride;                 // ($stride): 1 / D
    float* const dry_weight = pivot + $stride;             // ($stride): weights of joint friction
    float* const dry_force = dry_weight + $stride;         // ($stride): forces of joint friction
#if $elliptic
    float* const normal = dry_force + $stride;             // ($stride): a contact's row of the normal, less that of its slip
    float* const tangent = normal + $stride;               // ($stride): its row along the slip
    float* const weight = tangent + $stride;               // ($most_rows): second derivative of a row's cost
#else
    float* const weight = dry_force + $stride;             // ($most_rows): second derivative of a row's cost
#endif
    float* const force = weight + $most_rows;              // ($most_rows)
#if $elliptic
    // of contacts, whose rows are judged together: in shared memory, where the thread of the first row sees the others
    float* const residuals = force + $most_rows;           // ($most_rows)
    float* const changes = residuals + $most_rows;         // ($most_rows)
    float* const stiffnesses = changes + $most_rows;       // ($most_rows)
    float* const frictions = stiffnesses + $most_rows;     // ($most_rows): what makes the cone round
    float* const sizes = frictions + $most_rows;           // ($most_rows): rows of the contact whose first row this is, or 0
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
    EACH(e, 0, 4 * $stride) vector[e] = 0.0f;
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
        PER_ROW(stiffness);
        PER_ROW(residual); // J times acceleration, minus the reference
        PER_ROW(change);   // J times the search direction
        PER_DOF(loss);     // friction of the joints, by row
        const auto along = [&](int r) {
            if (r < dry) return vector[problem.dof.data[first + r]];
            return r < staged ? dot(jacobian + (r - dry) * $stride, vector) : dot(all_rows + r * $stride, vector);
        };
        ROWS(0, plain) {
            AT(stiffness) = problem.stiffness.data[padded + r];
            AT(residual) = along(r) - problem.reference.data[first + r];
            if (r < dry) OF(loss, r) = problem.loss.data[first + r];
        }
        // states in MuJoCo's order: satisfied, quadratic, linear on the negative side, linear on the positive side
        const auto zone = [&](int r, float d, float lost, float x) {
            if (r >= dry) return x < 0.0f ? 1 : 0;
            return d * x <= -lost ? 2 : d * x >= lost ? 3 : 1;
        };
        const auto push = [](int state, float d, float lost, float x) {
            return state == 1 ? -d * x : state == 2 ? lost : state == 3 ? -lost : 0.0f;
        };
        const auto cost = [](int state, float d, float lost, float x) {
            return state == 1 ? 0.5f * d * x * x : state == 0 ? 0.0f : lost * (fabsf(x) - 0.5f * lost / d);
        };
#if $elliptic
        EACH(r, plain, rows) {
            const int contact = problem.dof.data[first + r];
            const int begin = problem.contact_row.data[contact * problem.contact_row.shape[1]];
            const int size = wp::min(problem.contact_size.data[contact], rows - r);
            const auto friction = problem.contact_friction.data[contact];
            sizes[r] = begin == r ? static_cast<float>(size) : 0.0f;
            frictions[r] = begin != r ? friction[r - begin - 1] : size == 1 ? 1.0f
                : friction[0] * problem.impratio_root.data[world % problem.impratio_root.shape[0]];
            stiffnesses[r] = problem.stiffness.data[padded + r];
            residuals[r] = along(r) - problem.reference.data[first + r];
            changes[r] = 0.0f;
        }
        SYNC;
        // a contact after a step: 0 free, 1 sticks (all rows are quadratic), 4 slides (distance to the cone)
        struct Contact {
            int state, end;
            float mu, tangential, product, square, gap, weight;
        };
        const auto contact_at = [&](int r, float step) {
            Contact c;
            c.end = r + static_cast<int>(sizes[r]);
            c.mu = frictions[r];
            const float pressed = c.mu * (residuals[r] + step * changes[r]);
            float sum = c.product = c.square = 0.0f;
            for (int t = r + 1; t < c.end; ++t) {
                const float x = frictions[t] * (residuals[t] + step * changes[t]), v = frictions[t] * changes[t];
                sum += x * x;
                c.product += x * v;
                c.square += v * v;
            }
            c.tangential = sqrtf(sum);
            c.gap = pressed - c.mu * c.tangential;
            c.weight = stiffnesses[r] / wp::max(c.mu * c.mu * (1.0f + c.mu * c.mu), 1e-15f);
            if (c.tangential == 0.0f) c.state = pressed < 0.0f ? 1 : 0;
            else c.state = c.gap >= 0.0f ? 0 : c.mu * pressed + c.tangential <= 0.0f ? 1 : 4;
            return c;
        };
        const auto judge_contact = [&](int r, const Contact& c) {
            const float press = c.state == 4 ? -c.weight * c.gap * c.mu : 0.0f;
            for (int t = r; t < c.end; ++t) {
                const float x = residuals[t], s = frictions[t];
                weight[t] = c.state == 1 ? stiffnesses[t] : 0.0f;
                force[t] = c.state == 1 ? -stiffnesses[t] * x : 0.0f;
                if (c.state != 4) continue;
                weight[t] = t == r ? 0.0f : -c.weight * c.mu * c.gap / c.tangential * s * s;
                force[t] = t == r ? press : -press / c.tangential * x * s * s;
            }
        };
        EACH(r, plain, rows) if (sizes[r] > 0.0f) judge_contact(r, contact_at(r, 0.0f));
#endif
        PER_DOF(gradient);
        PER_DOF(direction);
        bool rebuild = true;
        float improvement = 0.0f;
        ROWS(0, plain) {
            const float lost = r < dry ? OF(loss, r) : 0.0f;
            const int state = zone(r, AT(stiffness), lost, AT(residual));
            weight[r] = state == 1 ? AT(stiffness) : 0.0f;
            force[r] = push(state, AT(stiffness), lost, AT(residual));
        }
        converged = false;
        while (true) {
            // gradient of the cost
            SYNC;
            EACH(r, 0, dry) {
                dry_weight[problem.dof.data[first + r]] = weight[r];
                dry_force[problem.dof.data[first + r]] = force[r];
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
                for (int r = plain; r < rows; r += wp::max(static_cast<int>(sizes[r]), 1)) {
                    const Contact c = contact_at(r, 0.0f);
                    if (sizes[r] == 0.0f || c.state != 4) continue;
                    EACH(j, 0, $stride) {
                        float sum = 0.0f;
                        for (int t = r + 1; t < c.end; ++t)
                            sum += frictions[t] * frictions[t] * residuals[t]
                                * (t < staged ? jacobian[(t - dry) * $stride + j] : all_rows[t * $stride + j]);
                        tangent[j] = sum / c.tangential;
                        normal[j] = (r < staged ? jacobian[(r - dry) * $stride + j] : all_rows[r * $stride + j]) - tangent[j];
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
            // exact search along it: the slope of the cost rises along the line, piece by piece straight
            PER_DOF(moved);
            float slope = 0.0f, curvature = 0.0f;
            DOFS(i) {
                OF(moved, i) = dot(inertia + i * $stride, vector);
                slope += OF(direction, i) * (OF(momentum, i) - OF(smooth, i));
                curvature += OF(direction, i) * OF(moved, i);
            }
            SUM(slope);
            SUM(curvature);
            ROWS(0, plain) AT(change) = along(r);
#if $elliptic
            EACH(r, plain, rows) changes[r] = along(r);
            SYNC;
#endif
            const auto evaluate = [&](float step, float& first_derivative, float& second_derivative, float& gross) {
                float one = 0.0f, two = 0.0f, size = 0.0f;
                ROWS(0, plain) {
                    const float lost = r < dry ? OF(loss, r) : 0.0f;
                    const float x = AT(residual) + step * AT(change);
                    const int state = zone(r, AT(stiffness), lost, x);
                    const float term = -push(state, AT(stiffness), lost, x) * AT(change);
                    one += term;
                    size += fabsf(term);
                    two += state == 1 ? AT(stiffness) * AT(change) * AT(change) : 0.0f;
                }
#if $elliptic
                EACH(r, plain, rows) if (sizes[r] > 0.0f) {
                    const Contact c = contact_at(r, step);
                    if (c.state == 4) {
                        const float rate = c.product / c.tangential, bend = (c.square - rate * rate) / c.tangential;
                        const float approach = c.mu * (changes[r] - rate);
                        one += c.weight * c.gap * approach;
                        size += fabsf(c.weight * c.gap * approach);
                        two += c.weight * (approach * approach - c.mu * c.gap * bend);
                    }
                    for (int t = r; t < (c.state == 1 ? c.end : r); ++t) {
                        const float term = stiffnesses[t] * (residuals[t] + step * changes[t]) * changes[t];
                        one += term;
                        size += fabsf(term);
                        two += stiffnesses[t] * changes[t] * changes[t];
                    }
                }
#endif
                SUM(one);
                SUM(two);
                SUM(size);
                first_derivative = slope + step * curvature + one;
                second_derivative = curvature + two;
                gross = fabsf(slope) + size;
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
                    if (descent < 0.0f) low = step; else high = step;
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
            ROWS(0, plain) {
                const float d = AT(stiffness), lost = r < dry ? OF(loss, r) : 0.0f, x = AT(residual);
                const float y = x + step * AT(change);
                const int before = zone(r, d, lost, x), after = zone(r, d, lost, y);
                saved += before == 1 && after == 1 ? 0.5f * d * (x - y) * (x + y) : cost(before, d, lost, x) - cost(after, d, lost, y);
                flips += before != after ? 1.0f : 0.0f;
                weight[r] = after == 1 ? d : 0.0f;
                force[r] = push(after, d, lost, y);
                AT(residual) = y;
            }
#if $elliptic
            EACH(r, plain, rows) if (sizes[r] > 0.0f) {
                const Contact before = contact_at(r, 0.0f), after = contact_at(r, step);
                flips += before.state != after.state || after.state == 4 ? 1.0f : 0.0f;
                for (int t = r; t < before.end; ++t) {
                    const float x = residuals[t], y = x + step * changes[t], half = 0.5f * stiffnesses[t];
                    saved += before.state == 1 && after.state == 1 ? half * (x - y) * (x + y)
                        : (before.state == 1 ? half * x * x : 0.0f) - (after.state == 1 ? half * y * y : 0.0f);
                    residuals[t] = y;
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
                SYNC;
                break;
            }
        }
        ROWS(0, plain) {
            solution.row_force.data[first + r] = force[r];
            solution.state.data[padded + r] = zone(r, AT(stiffness), r < dry ? OF(loss, r) : 0.0f, AT(residual));
        }
#if $elliptic
        EACH(r, plain, rows) if (sizes[r] > 0.0f) {
            const Contact c = contact_at(r, 0.0f);
            for (int t = r; t < c.end; ++t) {
                solution.row_force.data[first + t] = force[t];
                solution.state.data[padded + t] = c.state;
            }
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
#undef ROWS
#undef PER_DOF
#undef PER_ROW
#undef OF
#undef AT
#undef FROM
#undef SUM
#undef SYNC
#undef LINE
